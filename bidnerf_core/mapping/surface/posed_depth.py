"""Depth images with known poses, and the consistency checks between them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import RadianceField, RenderedImage, SceneBounds, render_image
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3

WITNESSES = 8
"""Maximum number of other images with which each point is compared."""


@dataclass(frozen=True, eq=False)
class PosedDepthImage:
    """An image with depth, its camera and its pose."""

    intrinsics: Intrinsics
    T_world_camera: SE3
    image: RenderedImage
    full_focal: float  # pixels, before the image was subsampled
    measured: bool = False  # by a sensor: opacity is 1 where it measured, and 0 elsewhere

    @property
    def focal(self) -> float:
        """The focal length (pixels) of the subsampled image."""
        return mean_focal(self.intrinsics)

    def solid(self, opacity: float) -> Bool[Tensor, "h w"]:
        """Return a mask of the pixels that show a surface with more than this opacity."""
        return (self.image.opacity > opacity) & (self.image.depth > 0)

    def points(self, pixels: Bool[Tensor, "h w"]) -> Float[Tensor, "p 3"]:
        """Return the points (metres, world) that these pixels show."""
        rays = self.intrinsics.unproject(self.intrinsics.pixel_centres())[pixels]
        return self.T_world_camera.to(torch.float32).apply(rays * self.image.depth[pixels][:, None])

    def beyond(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p"]:
        """Return how far beyond each point (metres, world) its line of sight ends (metres of depth); NaN outside the image."""
        local = self.T_world_camera.to(torch.float32).inverse().apply(points)
        u, v = self.intrinsics.project(local).unbind(-1)
        height, width = self.image.depth.shape
        within = (u >= 0) & (u < width) & (v >= 0) & (v < height)
        index = torch.where(within, v.floor() * width + u.floor(), 0).long()
        depth = self.image.depth.view(-1)[index]
        nothing = self.image.opacity.view(-1)[index] < 0.5
        # Without depth, a rendered pixel shows the background, but a measured one may show anything.
        behind = torch.where(nothing, torch.nan if self.measured else torch.inf, depth) - local[:, 2]
        return torch.where(within, behind, torch.nan)

    def smoothly_beyond(self, points: Float[Tensor, "p 3"], opacity: float) -> Float[Tensor, "p"]:
        """Return ``beyond`` with depth interpolated between four pixels; NaN where one of them shows no surface."""
        local = self.T_world_camera.to(torch.float32).inverse().apply(points)
        height, width = self.image.depth.shape
        place = 2 * self.intrinsics.project(local) / local.new_tensor([width, height]) - 1
        place = place.nan_to_num(2.0).clamp(-2, 2)[None, None]
        channels = torch.stack([self.image.depth, self.solid(opacity).float()])[None]
        depth, solid = grid_sample(channels, place, align_corners=False)[0, :, 0]
        return torch.where(solid > 0.999, depth - local[:, 2], torch.nan)


def mean_focal(intrinsics: Intrinsics) -> float:
    """Return the geometric mean of the focal lengths (pixels)."""
    return math.sqrt(intrinsics.fx * intrinsics.fy)


def rendered_image(
    field: RadianceField, bounds: SceneBounds, intrinsics: Intrinsics, T_world_camera: SE3, pixels: float
) -> PosedDepthImage:
    """Render the field from a pose at a resolution of about ``pixels`` pixels."""
    small = _shrunk(intrinsics, pixels)
    image = render_image(field, small, T_world_camera, bounds)
    return PosedDepthImage(small, T_world_camera.to("cpu", torch.float64), image, mean_focal(intrinsics))


def measured_image(view: View, pixels: float) -> PosedDepthImage:
    """Return a view's colours and measured depth, subsampled to about ``pixels`` pixels."""
    frame = view.frame
    small = _shrunk(frame.intrinsics, pixels)
    scale = torch.tensor([frame.intrinsics.width / small.width, frame.intrinsics.height / small.height])
    columns, rows = (small.pixel_centres() * scale).long().unbind(-1)
    depth = torch.zeros(rows.shape) if frame.depth is None else frame.depth.cpu()[rows, columns]
    depth = torch.where(depth.isfinite() & (depth > 0), depth, 0)
    image = RenderedImage(frame.colours_at(rows, columns).cpu(), depth, (depth > 0).to(depth))
    T = view.T_ref_camera.to("cpu", torch.float64)
    return PosedDepthImage(small, T, image, mean_focal(frame.intrinsics), True)


def _shrunk(intrinsics: Intrinsics, pixels: float) -> Intrinsics:
    """Return the camera scaled down to about ``pixels`` pixels; unchanged if it has fewer."""
    return intrinsics.scaled(min(1.0, math.sqrt(pixels / (intrinsics.width * intrinsics.height))))


def agreed(
    points: Float[Tensor, "p 3"],
    number: int,
    images: Sequence[PosedDepthImage],
    tolerance: float,
    needed: int,
) -> Bool[Tensor, "p"]:
    """Return a mask of the points of image ``number`` that other images confirm to within ``tolerance`` (metres).

    At least ``needed`` images must confirm a point, and no more than confirm it may see through it.
    """
    agree, against = (torch.zeros(len(points), dtype=torch.int32) for _ in range(2))
    others = witnesses(number, images)
    for other in others:
        beyond = images[other].beyond(points)
        agree += (beyond.abs() <= tolerance).int()
        against += (beyond > tolerance).int()
    return (agree >= min(needed, len(others))) & (agree >= against)


def witnesses(number: int, images: Sequence[PosedDepthImage]) -> list[int]:
    """Return the images with the most similar poses, which are the most likely to show the same points."""
    here = images[number].T_world_camera
    centres = torch.stack([s.T_world_camera.translation for s in images])
    axes = torch.stack([s.T_world_camera.rotation[:, 2] for s in images])
    away = torch.linalg.vector_norm(centres - here.translation, dim=-1)
    turned = 1 - axes @ here.rotation[:, 2]
    order = (away / away.mean().clamp(min=1e-9) + turned).argsort().tolist()
    return [i for i in order if i != number][:WITNESSES]
