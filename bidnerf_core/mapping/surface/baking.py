"""Baking the surface of any field from depth rendered or measured at many poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.fields import RadianceField, SceneBounds, VoxelGrid, device_of, render, render_image
from bidnerf_core.frames import Frame, View, draw, uniform
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping.surface.posed_depth import (
    WITNESSES,
    PosedDepthImage,
    choose_grid,
    confirm_points,
    depth_noise,
    finest_cell,
    footprint,
    posed_measurement,
    render_posed,
)
from bidnerf_core.mapping.surface.surface_map import SurfaceMap, fuse_surfels, merge_cells
from bidnerf_core.mapping.surface.surfel_index import MOST_CELLS, SurfelIndex
from bidnerf_core.progress import counter
from bidnerf_core.settings import Above, Range, Settings

PosedCamera = tuple[Intrinsics, SE3]
"""Intrinsics and T_world_camera."""


def render_views(field: RadianceField, bounds: SceneBounds, cameras: Sequence[PosedCamera]) -> list[View]:
    """Render colour and depth of ``field`` at up to 100 of ``cameras``, at regular intervals, for a map without photos."""
    chosen = cameras[:: max(1, math.ceil(len(cameras) / 100))]
    views, count = list[View](), counter("rendering", "views")
    for number, (intrinsics, T) in enumerate(chosen):
        count(number, len(chosen))
        small = intrinsics.at_most(400)
        image = render_image(field, small, T, bounds)
        views.append(View(Frame(f"{number:04d}", image.rgb, small, image.depth), T))
    return views


@torch.no_grad()
def colour_noise(field: RadianceField, bounds: SceneBounds, views: Sequence[View]) -> float:
    """Return the root mean square difference between rendered and photographed colours over random pixels of all views."""
    count, generator = max(4096, len(views)), torch.Generator().manual_seed(0)
    pixels = draw(views, count, uniform, generator, device=device_of(field)).flattened()
    seen = render(field, bounds.rays(pixels.origins, pixels.directions), bounds.background)
    return float((seen.rgb - pixels.rgb).square().mean().sqrt())


@dataclass(frozen=True)
class BakeConfig(Settings):
    """Settings for baking."""

    # number of rendered rays, divided equally among the views
    rays: Annotated[int, Range(1000, 10**9)] = 300_000
    # number of pixels of measured depth used, divided equally among the views
    measured: Annotated[int, Range(1000, 10**9)] = 2_000_000
    # maximum number of cells in the scene's box; those far from the surface take no memory (default: limited by `megabytes` only)
    cells: Annotated[int, Range(1000, MOST_CELLS)] = MOST_CELLS
    megabytes: Annotated[float, Above(0)] = 200.0  # memory limit of the surface, which makes cells coarser
    opacity: Annotated[float, Above(0, 0.999)] = 0.9  # opacity below which a ray meets no surface
    # minimum number of other views in which a point must lie on the surface
    agreement: Annotated[int, Range(0, WITNESSES)] = 2


def bake(
    field: RadianceField,
    bounds: SceneBounds,
    cameras: Sequence[tuple[Intrinsics, SE3]],
    views: Sequence[View] = (),
    config: BakeConfig = BakeConfig(),
) -> SurfaceMap:
    """Bake the surface on which measured depth of ``views`` and depth rendered from ``cameras`` (T_world_camera) agree.

    Points confirmed by several of these images are fused into surfels and indexed by a grid whose cells are as fine as the images and their
    noise allow (see ``finest_cell``). Measured depth is more accurate than a field trained on it, so pass only ``cameras`` of images
    without measured depth. Raises ``InputError`` if there are no images, or no points on which they agree.
    """
    total = len(views) + len(cameras)
    if not total:
        raise InputError("no images to bake a surface from:", expected="at least one camera or view")
    images, count = (
        [posed_measurement(view, config.measured / total) for view in views],
        counter("baking", "views"),
    )
    for number, (intrinsics, T) in enumerate(cameras, start=1):
        images.append(render_posed(field, bounds, intrinsics, T, config.rays / total))
        count(len(views) + number, total)
    cell = max(finest_cell(images, config.opacity), VoxelGrid.filling(bounds, config.cells).cell)
    tolerance = 2 * max(cell, depth_noise(images, config.opacity, PosedDepthImage.beyond))
    parts, colours = [], []
    for number, posed in enumerate(images):
        solid = posed.solid(config.opacity)
        seen = posed.points(solid)
        confirmed = confirm_points(seen, number, images, tolerance, config.agreement)
        parts.append(seen[confirmed])
        colours.append(posed.image.rgb[solid][confirmed])
    points, rgb = torch.cat(parts), torch.cat(colours)
    inside = VoxelGrid.covering(bounds, cell).contains(points)
    if not bool(inside.any()):
        raise InputError("no surface to bake: no point that several views agree on")
    coarsest, keyframes = footprint(images, config.opacity, subsampled=True), [image.T_world_camera for image in images]
    return _fuse(points[inside], rgb[inside], bounds, (cell, coarsest), keyframes, config)


def surface_of_points(
    points: Float[Tensor, "p 3"],
    rgb: Float[Tensor, "p 3"],
    bounds: SceneBounds,
    cameras: Sequence[PosedCamera],
    config: BakeConfig = BakeConfig(),
) -> SurfaceMap:
    """Bake the surface from points on it (metres, world), such as a scan's; ``cameras`` become its keyframes.

    The cells follow the density of the points. Raises ``InputError`` for fewer than two points within the bounds.
    """
    inside = VoxelGrid.covering(bounds, VoxelGrid.filling(bounds, config.cells).cell).contains(points)
    points, rgb = points[inside].float(), rgb[inside].float()
    if len(points) < 2:
        raise InputError(f"no surface to bake: {len(points)} points within the bounds of the scene")
    coordinates = points.numpy()
    away, _ = cKDTree(coordinates).query(coordinates[:: max(1, len(points) // 5000)], k=2)
    finest = max(float(np.median(np.asarray(away)[:, 1])), VoxelGrid.filling(bounds, config.cells).cell)
    return _fuse(points, rgb, bounds, (finest, 4 * finest), [T for _, T in cameras], config)


def _fuse(
    points: Float[Tensor, "p 3"],
    rgb: Float[Tensor, "p 3"],
    bounds: SceneBounds,
    cells: tuple[float, float],
    keyframes: Sequence[SE3],
    config: BakeConfig,
) -> SurfaceMap:
    """Fuse points into a surface; ``cells`` are the finest and the coarsest permitted cell size (metres)."""
    grid = choose_grid(points, bounds, *cells, config.megabytes)
    _, (positions, colours) = merge_cells(grid.numbers(points), points, rgb)
    surfels = fuse_surfels(positions, colours)
    poses = torch.stack([T.matrix() for T in keyframes]) if keyframes else torch.zeros(0, 4, 4)
    return SurfaceMap(surfels, SurfelIndex.of(surfels.positions, grid), poses)
