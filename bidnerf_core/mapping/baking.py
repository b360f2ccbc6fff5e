"""Baking: the surface of any field, from depth that was rendered or measured from many places."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.field import RadianceField, SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.mapping.surface_map import SurfaceMap, nearest_surfels
from bidnerf_core.mapping.surfels import fused_surfels, merged
from bidnerf_core.rendering import RenderedImage, render_image
from bidnerf_core.se3 import SE3
from bidnerf_core.settings import Above, Range, Settings
from bidnerf_core.voxel_grid import VoxelGrid

WITNESSES = 8
"""Largest number of other views with which each point is compared."""


@dataclass(frozen=True)
class BakeConfig(Settings):
    """Settings of baking."""

    # number of rays rendered, shared out equally among the views
    rays: Annotated[int, Range(1000, 10**9)] = 300_000
    cells: Annotated[int, Range(1000, 10**9)] = 4_000_000  # largest number of cells of the grid
    opacity: Annotated[float, Above(0, 0.999)] = 0.9  # opacity below which a ray meets no surface
    # number of other views in which a point must lie on the surface
    agreement: Annotated[int, Range(0, WITNESSES)] = 2


@dataclass(frozen=True, eq=False)
class PosedDepthImage:
    """An image with depth, its camera and its pose."""

    intrinsics: Intrinsics
    T_world_camera: SE3
    image: RenderedImage
    measured: bool = False  # by a sensor: opacity is 1 where it measured, and 0 where nothing is known


def bake(
    field: RadianceField,
    bounds: SceneBounds,
    cameras: Sequence[tuple[Intrinsics, SE3]],
    views: Sequence[View] = (),
    config: BakeConfig = BakeConfig(),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SurfaceMap:
    """Return the surface that the measured depth of ``views`` and depth rendered from ``cameras`` (T_world_camera) agree on.

    Points on which several of these images agree are kept, fused into surfels and indexed by a grid. Measured depth is more
    accurate than a field that was trained on it, so render depth only where none was measured. Raises ``InputError`` if
    there is no image, or no point on which they agree.
    """
    total = len(views) + len(cameras)
    if not total:
        raise InputError("nothing to bake a surface from: expected at least one camera or view")
    pixels = config.rays / total
    images = [_measured(view, pixels) for view in views]
    for number, (intrinsics, T) in enumerate(cameras, start=1):
        small = _shrunk(intrinsics, pixels)
        image = render_image(field, small, T, bounds)
        images.append(PosedDepthImage(small, T.to("cpu", torch.float64), image))
        progress(len(views) + number, total)
    return surface_of(images, bounds, config)


def surface_of(images: Sequence[PosedDepthImage], bounds: SceneBounds, config: BakeConfig) -> SurfaceMap:
    """Return the surface that images with depth show, see ``bake``."""
    grid = VoxelGrid.filling(bounds, config.cells)
    points, rgb = _agreed_points(images, 2 * grid.cell, config)
    inside = grid.contains(points)
    occupied, (positions, colours) = merged(grid.numbers(points[inside]), points[inside], rgb[inside])
    nearest = nearest_surfels(occupied, grid.shape)
    keyframes = torch.stack([image.T_world_camera.matrix() for image in images])
    return SurfaceMap(fused_surfels(positions, colours), grid, nearest, keyframes)


def _measured(view: View, pixels: float) -> PosedDepthImage:
    """Return a view's colours and measured depth, thinned out to about ``pixels``."""
    frame = view.frame
    small = _shrunk(frame.intrinsics, pixels)
    scale = torch.tensor([frame.intrinsics.width / small.width, frame.intrinsics.height / small.height])
    columns, rows = (small.pixel_centres() * scale).long().unbind(-1)
    depth = torch.zeros(rows.shape) if frame.depth is None else frame.depth.cpu()[rows, columns]
    depth = torch.where(depth.isfinite() & (depth > 0), depth, 0)
    image = RenderedImage(frame.rgb.cpu()[rows, columns], depth, (depth > 0).to(depth))
    return PosedDepthImage(small, view.T_ref_camera.to("cpu", torch.float64), image, True)


def _shrunk(intrinsics: Intrinsics, pixels: float) -> Intrinsics:
    """Return the same camera with about ``pixels`` pixels, or as it is where it has fewer."""
    return intrinsics.scaled(min(1.0, math.sqrt(pixels / (intrinsics.width * intrinsics.height))))


def _agreed_points(
    images: Sequence[PosedDepthImage], tolerance: float, config: BakeConfig
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3"]]:
    """Return the points (metres, world) that other images show at the same place, to within ``tolerance`` (metres), and
    their colours.
    """
    points, colours = [], []
    for number, posed in enumerate(images):
        solid = (posed.image.opacity > config.opacity) & (posed.image.depth > 0)
        rays = posed.intrinsics.unproject(posed.intrinsics.pixel_centres())
        seen = posed.T_world_camera.to(torch.float32).apply(rays[solid] * posed.image.depth[solid][:, None])
        kept = _agreed(seen, number, images, tolerance, config.agreement)
        points.append(seen[kept])
        colours.append(posed.image.rgb[solid][kept])
    return torch.cat(points), torch.cat(colours)


def _agreed(
    points: Float[Tensor, "p 3"],
    number: int,
    images: Sequence[PosedDepthImage],
    tolerance: float,
    needed: int,
) -> Bool[Tensor, "p"]:
    """Return which points of an image enough others show, and no fewer than look through it."""
    agree, against = (torch.zeros(len(points), dtype=torch.int32) for _ in range(2))
    others = _witnesses(number, images)
    for other in others:
        beyond = _beyond(points, images[other])
        agree += (beyond.abs() <= tolerance).int()
        against += (beyond > tolerance).int()
    return (agree >= min(needed, len(others))) & (agree >= against)


def _witnesses(number: int, images: Sequence[PosedDepthImage]) -> list[int]:
    """Return the images with the most similar poses: they are the likeliest to show the same points."""
    here = images[number].T_world_camera
    centres = torch.stack([s.T_world_camera.translation for s in images])
    axes = torch.stack([s.T_world_camera.rotation[:, 2] for s in images])
    away = torch.linalg.vector_norm(centres - here.translation, dim=-1)
    turned = 1 - axes @ here.rotation[:, 2]
    order = (away / away.mean().clamp(min=1e-9) + turned).argsort().tolist()
    return [i for i in order if i != number][:WITNESSES]


def _beyond(points: Float[Tensor, "p 3"], posed: PosedDepthImage) -> Float[Tensor, "p"]:
    """Return how far behind each point its line of sight ends (metres of depth); NaN where the image does not show it."""
    local = posed.T_world_camera.to(torch.float32).inverse().apply(points)
    u, v = posed.intrinsics.project(local).unbind(-1)
    height, width = posed.image.depth.shape
    within = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = torch.where(within, v.floor() * width + u.floor(), 0).long()
    depth = posed.image.depth.view(-1)[index]
    nothing = posed.image.opacity.view(-1)[index] < 0.5
    # Without depth, a rendered image shows the background, and a measured one may show anything.
    behind = torch.where(nothing, torch.nan if posed.measured else torch.inf, depth) - local[:, 2]
    return torch.where(within, behind, torch.nan)
