"""The free space of a view: how far its pixels see before any matter, and which spheres lie entirely within it.

When in doubt, space counts as occupied: where nothing was measured, and beyond the depth that
any neighbouring pixel sees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame, View

AROUND = np.ones((3, 3), np.uint8)
"""A pixel and its eight neighbours."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The depth up to which a view is free. Level k holds the smallest such depth (planar z) within k pixels of each pixel."""

    intrinsics: Intrinsics  # of the shrunken image
    levels: Float[Tensor, "k h w"]  # metres; 0: unknown
    reach: float  # metres: the largest free depth of any pixel
    # inward normals of planes through the camera's centre that enclose the whole view
    edges: Float[Tensor, "4 3"]

    @staticmethod
    def seen_by(view: View, tolerance: float = 0.02, footprint: int = 8) -> FreeSpace:
        """Return the free space of a view.

        Its depth image is downsampled by an integer factor to at most 400 pixels a side, keeping the minimum depth of each
        block; that suffices for coarse cells and bounds the time.
        """
        free, camera = _free_depth(view.frame, tolerance), view.frame.intrinsics
        height, width = free.shape
        factor = math.ceil(max(free.shape) / 400)
        padded = functional.pad(free, (0, -width % factor, 0, -height % factor))
        levels = [-functional.max_pool2d(-padded[None], factor)[0].cpu().numpy()]
        for _ in range(footprint):  # nothing is known beyond the image's edge
            levels.append(cv2.erode(levels[-1], AROUND, borderType=cv2.BORDER_CONSTANT, borderValue=0.0))
        fx, fy, cx, cy = (value / factor for value in (camera.fx, camera.fy, camera.cx, camera.cy))
        height, width = levels[0].shape
        small = Intrinsics(fx, fy, cx, cy, width, height, camera.distortion)
        return FreeSpace(small, torch.from_numpy(np.stack(levels)), free.amax().item(), _edges(camera))

    def may_free(self, points: Float[Tensor, "3 n"], radius: float) -> Bool[Tensor, "n"]:
        """Return whether the view sees any part of the sphere around each point (camera frame) within its free depth."""
        in_sight = (self.edges @ points > -radius).all(dim=0)
        return in_sight & (points[2] > -radius) & (points[2] - radius < self.reach)

    def frees(self, points: Float[Tensor, "3 n"], radius: float) -> Bool[Tensor, "n"]:
        """Return whether the whole sphere of ``radius`` metres around each point (camera frame, metres) is free."""
        deepest = points[2] + radius
        columns, rows, pixels = self._footprint(points, radius)
        count, height, width = self.levels.shape
        known = (points[2] > radius) & (deepest < self.reach) & (pixels < count)
        known &= (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        # Integers in floats are exact, since these are below 2^24.
        place = (pixels * height + rows) * width + columns
        least = self.levels.flatten()[torch.where(known, place, 0).long()]
        return known & (deepest < least)

    def _footprint(self, points: Float[Tensor, "3 n"], radius: float) -> tuple[Tensor, Tensor, Tensor]:
        """Return the column, row and radius, in whole pixels, of each sphere's image; the radius is infinite for spheres out of view."""
        camera = self.intrinsics
        inverse = 1 / points[2]
        x, y = points[0] * inverse, points[1] * inverse
        squared = x * x + y * y  # of the tangent of the angle to the axis
        slope = radius * inverse  # becomes the tangent of the sphere's angular radius in the next line
        slope = slope * (1 + squared - slope * slope).rsqrt()
        product = squared.sqrt() * slope
        # tan(a + b) - tan(a): the far side of the sphere's image
        wide = slope * (1 + squared) / (1 - product)
        pixels = (wide * max(camera.fx, camera.fy)).ceil()
        pixels = torch.where(product < 1, pixels, torch.inf)  # also where it is NaN
        if not camera.distortion:
            return (x * camera.fx + camera.cx).floor(), (y * camera.fy + camera.cy).floor(), pixels
        u, v = camera.project(points.T).floor().unbind(-1)
        # Distortion enlarges the footprint a little; outside the image, its polynomial may fold back into the image.
        return u, v, torch.where((self.edges @ points > 0).all(dim=0), (pixels * 1.25).ceil(), torch.inf)


def _free_depth(frame: Frame, tolerance: float) -> Float[Tensor, "h w"]:
    """Return the planar z (metres) up to which space is free at each pixel: infinite for background, 0 where nothing is known."""
    free = torch.zeros(frame.rgb_bytes.shape[:2])
    if frame.depth is not None:
        free = frame.depth.float() * (1 - tolerance)
    if frame.alpha is not None:  # a pixel on an edge covers two depths but has one measurement
        free = torch.where(frame.alpha >= 1, free, torch.where(frame.alpha <= 0, torch.inf, 0.0))
    if frame.hidden is not None:
        free = torch.where(frame.hidden, 0.0, free)
    return free


def _edges(camera: Intrinsics) -> Float[Tensor, "4 3"]:
    """Return the inward normals of the frustum whose section at z = 1 is the bounding box of the (distorted) image border."""
    w, h = camera.width, camera.height
    along = torch.linspace(0, 1, 33, dtype=torch.float64)
    still = torch.zeros_like(along)
    sides = [(along * w, still), (along * w, still + h), (still, along * h), (still + w, along * h)]
    border = camera.unproject(torch.cat([torch.stack(side, dim=-1) for side in sides]))
    (left, top, _), (right, bottom, _) = border.amin(dim=0).tolist(), border.amax(dim=0).tolist()
    normals = torch.tensor([[1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]])
    return functional.normalize(normals, dim=-1).float()
