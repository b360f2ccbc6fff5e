"""Carving: the cells of a box that no views see through, and the free space of a view: the depth up to which its pixels see no matter.

A cell is represented by its circumscribed sphere, which must lie entirely within the free space of a view.

When in doubt, space counts as occupied: where nothing was measured, and beyond the depth that any neighbouring pixel sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from bidnerf_core.camera import Intrinsics
from bidnerf_core.devices import move_to, threads_at_most
from bidnerf_core.fields import VoxelGrid
from bidnerf_core.frames import View

CPU = torch.device("cpu")
RAY_BLOCK = 8
"""Cells along the side of a block. Processing a block for a view that does not see it costs next to nothing."""
AROUND = np.ones((3, 3), np.uint8)
"""A pixel and its eight neighbours."""


@dataclass(frozen=True, eq=False)
class FreeSpace:
    """The depth (planar z) up to which a view's pixels see no matter. Level k holds the least such depth within k pixels of each pixel."""

    intrinsics: Intrinsics  # of the shrunken image
    levels: Float[Tensor, "k h w"]  # metres; 0: unknown
    reach: float  # metres: the largest free depth of any pixel
    # inward normals of planes through the camera's centre that enclose the whole view
    edges: Float[Tensor, "4 3"]

    @staticmethod
    def seen_by(view: View, tolerance: float = 0.02, footprint: int = 8) -> FreeSpace:
        """Return the free space of a view.

        The depth image is downsampled by an integer factor to at most 400 pixels a side, keeping the minimum depth of each block; that
        suffices for coarse cells and bounds the time. ``tolerance`` is the relative error of measured depth, and ``footprint`` the highest
        level.
        """
        frame, camera = view.frame, view.frame.intrinsics
        # The planar z (metres) up to which space is free at each pixel: infinite for background, 0 where nothing is known
        free = torch.zeros(frame.rgb_bytes.shape[:2]) if frame.depth is None else frame.depth.float() * (1 - tolerance)
        if frame.alpha is not None:  # a pixel on an edge covers two depths but has one measurement
            free = torch.where(frame.alpha >= 1, free, torch.where(frame.alpha <= 0, torch.inf, 0.0))
        if frame.hidden is not None:
            free = torch.where(frame.hidden, 0.0, free)
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
        """Return a mask of the spheres of ``radius`` around ``points`` (camera frame; metres) that may be partly free in this view."""
        in_sight = (self.edges @ points > -radius).all(dim=0)
        return in_sight & (points[2] > -radius) & (points[2] - radius < self.reach)

    def frees(self, points: Float[Tensor, "3 n"], radius: float) -> Bool[Tensor, "n"]:
        """Return a mask of the points (camera frame, metres) whose sphere of ``radius`` metres is entirely free."""
        deepest = points[2] + radius
        columns, rows, pixels = self._footprint(points, radius)
        count, height, width = self.levels.shape
        known = (points[2] > radius) & (deepest < self.reach) & (pixels < count)
        known &= (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
        # Integers in floats are exact, since these are below 2^24.
        index = (pixels * height + rows) * width + columns
        return known & (deepest < self.levels.flatten()[torch.where(known, index, 0).long()])

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


def occupied_voxels(views: Sequence[View], grid: VoxelGrid, device: torch.device = CPU) -> Bool[Tensor, "x y z"]:
    """Return which cells of ``grid`` may hold matter, see ``occupied_cells``.

    The relative tolerance of depth is 5 %, since sensors err by a few per cent, and an emptied cell is never filled again.
    In contracted space, the inner half of the grid, whose shape is divisible by 4, is the box; cells outside of the box
    are always kept.
    """
    inner, middle = grid, [slice(None)] * 3
    if grid.contracted is not None:
        quarter = grid.shape[0] // 4
        inner = VoxelGrid.cube(replace(grid.contracted, contracted=False), 2 * quarter)
        middle = [slice(quarter, quarter + inner.shape[0])] * 3
    occupied = torch.ones(grid.shape, dtype=torch.bool, device=device)
    occupied[middle[0], middle[1], middle[2]] = occupied_cells(
        views, inner.lower, inner.upper, inner.shape, 0.05, device=device
    )
    return occupied


def occupied_cells(
    views: Sequence[View],
    lower: Sequence[float],
    upper: Sequence[float],
    shape: tuple[int, int, int],
    tolerance: float = 0.02,
    footprint: int = 8,
    device: torch.device = CPU,
) -> Bool[Tensor, "nx ny nz"]:
    """Return on ``device`` which cells of the box ``lower``..``upper`` (metres, world) may hold matter.

    A cell is emptied when two views (one, if there is only one) see all of it as free: as background (alpha 0), or nearer
    than the measured depth by more than a fraction ``tolerance`` of that depth. Pixels without a measurement empty nothing, nor
    does a view in which the cell's radius is over ``footprint`` pixels.

    Cells are processed in blocks, which may reach beyond the box.
    """
    counts = [-(-count // RAY_BLOCK) for count in shape]
    first = torch.tensor(lower, dtype=torch.float64)
    size = (torch.tensor(upper, dtype=torch.float64) - first) / torch.tensor(shape)  # of a cell
    radius = torch.linalg.vector_norm(size).item() / 2
    blocks, cells = _indices(counts), _indices([RAY_BLOCK] * 3)
    votes = torch.zeros(blocks.shape[1], RAY_BLOCK**3, dtype=torch.uint8, device=device)
    needed = 1 if len(views) < 2 else 2
    undecided = torch.ones(len(votes), dtype=torch.bool, device=device)
    at_once = 128 if device.type == "cpu" else max(1, len(votes))  # so few blocks stay in the cache
    with threads_at_most(1):  # more threads would slow down such short operations
        for view in (view for view in views if view.frame.has_depth or view.frame.alpha is not None):
            space = move_to(FreeSpace.seen_by(view, tolerance, footprint), device)
            # In double precision, since the world's origin may be far away.
            T_camera_world = view.T_ref_camera.to(torch.float64).inverse()
            # The middles of the blocks' first cells, and the offsets of a block's cells from them (metres, camera frame)
            step = T_camera_world.rotation * size
            corner = T_camera_world.apply(first + size / 2)[:, None] + step @ (blocks * RAY_BLOCK).double()
            corners, within = move_to((corner.float(), (step @ cells.double()).float()), device)
            seen = space.may_free(corners + within.mean(dim=1, keepdim=True), RAY_BLOCK * radius)
            for rows in (seen & undecided).nonzero()[:, 0].split(at_once):
                points = (corners[:, rows, None] + within[:, None, :]).flatten(1)
                freed = space.frees(points, radius).unflatten(0, (-1, RAY_BLOCK**3))
                votes[rows] = (votes[rows] + freed).clamp(max=needed)  # a byte would overflow with many views
                undecided[rows] = (votes[rows] < needed).any(dim=1)
        whole = (votes < needed).reshape(*counts, RAY_BLOCK, RAY_BLOCK, RAY_BLOCK).permute(0, 3, 1, 4, 2, 5)
        whole = whole.reshape([count * RAY_BLOCK for count in counts])
        return whole[: shape[0], : shape[1], : shape[2]].contiguous()


def _indices(counts: Sequence[int]) -> Int[Tensor, "3 n"]:
    return torch.cartesian_prod(*(torch.arange(count) for count in counts)).T
