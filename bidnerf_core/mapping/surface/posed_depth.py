"""Depth images with known poses: their consistency, and the cell size that they and a memory limit allow for a surface."""

from __future__ import annotations

import math
import statistics
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from bidnerf_core.camera import Intrinsics
from bidnerf_core.depth import UNKNOWN
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.fields import RadianceField, RenderedImage, SceneBounds, VoxelGrid, render_image
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, mad_deviation
from bidnerf_core.mapping.surface.surface_map import SURFEL_BYTES
from bidnerf_core.mapping.surface.surfel_index import BLOCK_SIDE, MOST_CELLS, block_levels, index_bytes

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

    def solid(self, opacity: float) -> Bool[Tensor, "h w"]:
        """Return a mask of the pixels that have depth and an opacity of more than ``opacity``."""
        return (self.image.opacity > opacity) & (self.image.depth > 0)

    def points(self, pixels: Bool[Tensor, "h w"]) -> Float[Tensor, "p 3"]:
        """Return the points (metres, world) that these pixels show."""
        rays = self.intrinsics.unproject(self.intrinsics.pixel_centres())[pixels]
        return self.T_world_camera.to(torch.float32).apply(rays * self.image.depth[pixels][:, None])

    def beyond(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p"]:
        """Return the image's depth minus that of each point (metres, world): infinite for background, NaN if unknown or out of view."""
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
        grid = 2 * self.intrinsics.project(local) / local.new_tensor([width, height]) - 1
        grid = grid.nan_to_num(2.0).clamp(-2, 2)[None, None]
        channels = torch.stack([self.image.depth, self.solid(opacity).float()])[None]
        depth, solid = grid_sample(channels, grid, align_corners=False)[0, :, 0]
        return torch.where(solid > 0.999, depth - local[:, 2], torch.nan)


def mean_focal(intrinsics: Intrinsics) -> float:
    """Return the geometric mean of the focal lengths (pixels)."""
    return math.sqrt(intrinsics.fx * intrinsics.fy)


def render_posed(
    field: RadianceField, bounds: SceneBounds, intrinsics: Intrinsics, T_world_camera: SE3, pixels: float
) -> PosedDepthImage:
    """Render the field from a pose at a resolution of about ``pixels`` pixels."""
    small = _shrunk(intrinsics, pixels)
    image = render_image(field, small, T_world_camera, bounds)
    return PosedDepthImage(small, T_world_camera.to("cpu", torch.float64), image, mean_focal(intrinsics))


def posed_measurement(view: View, pixels: float) -> PosedDepthImage:
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
    """Return the camera downscaled to about ``pixels`` pixels; unchanged if it has fewer."""
    return intrinsics.scaled(min(1.0, math.sqrt(pixels / (intrinsics.width * intrinsics.height))))


def confirm_points(
    points: Float[Tensor, "p 3"],
    number: int,
    images: Sequence[PosedDepthImage],
    tolerance: float,
    needed: int,
) -> Bool[Tensor, "p"]:
    """Return a mask of the points of image ``number`` that other images confirm to within ``tolerance`` (metres).

    At least ``needed`` images must confirm a point, and no more images may see through it than confirm it.
    """
    agree, against = (torch.zeros(len(points), dtype=torch.int32) for _ in range(2))
    others = witnesses(number, images)
    for other in others:
        beyond = images[other].beyond(points)
        agree += (beyond.abs() <= tolerance).int()
        against += (beyond > tolerance).int()
    return (agree >= min(needed, len(others))) & (agree >= against)


def witnesses(number: int, images: Sequence[PosedDepthImage]) -> list[int]:
    """Return the numbers of the images most likely to show the same points as image ``number``: those with the most similar poses."""
    here = images[number].T_world_camera
    centres = torch.stack([s.T_world_camera.translation for s in images])
    axes = torch.stack([s.T_world_camera.rotation[:, 2] for s in images])
    away = torch.linalg.vector_norm(centres - here.translation, dim=-1)
    turned = 1 - axes @ here.rotation[:, 2]
    order = (away / away.mean().clamp(min=1e-9) + turned).argsort().tolist()
    return [i for i in order if i != number][:WITNESSES]


COARSER = 2**0.25
"""Factor by which cells grow until they contain enough points and fit into memory."""


def finest_cell(images: Sequence[PosedDepthImage], opacity: float) -> float:
    """Return the finest cell (metres) that the images' resolution and the noise of measured depth justify.

    It is 0.7 times a pixel's footprint, since several images together resolve more than a single one, and at least two standard
    deviations of depth: with finer cells, a plane would become several layers of surfels. Rendered images are too sparsely
    sampled to distinguish noise from scene structure.
    """
    measured = [posed for posed in images if posed.measured]
    return max(0.7 * footprint(images, opacity), 2 * depth_noise(measured, opacity))


def footprint(images: Sequence[PosedDepthImage], opacity: float, subsampled: bool = False) -> float:
    """Return the side (metres) of a pixel's footprint at the median distance; 0 if no surface is visible.

    The pixel is one of the full resolution or, if ``subsampled``, of the images as they are here.
    """
    shown = [(d, mean_focal(x.intrinsics) if subsampled else x.full_focal) for x, d in _depths(images, opacity)]
    return _median([float(depths.median()) / focal for depths, focal in shown])


def depth_noise(
    images: Sequence[PosedDepthImage],
    opacity: float,
    beyond: Callable[[PosedDepthImage, Float[Tensor, "p 3"]], Float[Tensor, "p"]] | None = None,
) -> float:
    """Return the robust standard deviation (metres) of an image's depth, from differences between images of the same points.

    The differences are those of ``beyond``, by default of depth that is interpolated between pixels. With depth of the nearest
    pixel, they include the discretization error of the subsampled images. Up to 40 images are compared with others, each at a
    few hundred points. The result includes pose errors, and is 0 if no two images show the same points.

    Differences of more than five times the median are occlusions or gross errors. The result is at most two standard deviations
    of an unknown sensor, since images that differ by more are inconsistent.
    """
    beyond = beyond or (lambda posed, points: posed.smoothly_beyond(points, opacity))
    parts = [torch.zeros(0)]
    for number in range(0, len(images), max(1, math.ceil(len(images) / 40))):
        points = images[number].points(images[number].solid(opacity))
        points = points[:: max(1, len(points) // 400)]
        parts += [beyond(images[other], points).abs() for other in witnesses(number, images)]
    differences = torch.cat(parts)
    differences = differences[differences.isfinite()]
    if not len(differences):
        return 0.0
    near = differences[differences <= 5 * differences.median()]
    distance = _median([float(depths.median()) for _, depths in _depths(images, opacity)])
    return min(mad_deviation(near) / math.sqrt(2), 2 * UNKNOWN.noise.deviation(distance))


def choose_grid(
    points: Float[Tensor, "p 3"], bounds: SceneBounds, finest: float, coarsest: float, megabytes: float
) -> VoxelGrid:
    """Return a grid with cells of ``finest`` metres, or coarser if points (metres, world) or memory are scarce.

    Points are scarce below 1.32 per occupied cell. At that density, randomly scattered points leave 5/9 of the cells empty;
    with fewer points, the mean distance between surfels exceeds the radius of their discs, which is 1.5 cells. Cells then grow up to
    ``coarsest`` at most, at which each contains a pixel. If the limit of ``megabytes`` makes them larger, an ``InputWarning``
    states by how much. Raises ``InputError`` if no cell size satisfies that limit.
    """
    grid = VoxelGrid.covering(bounds, finest)
    while grid.cell < coarsest and len(points) < 1.32 * len(grid.numbers(points).unique()):
        grid = VoxelGrid.covering(bounds, min(COARSER * grid.cell, coarsest))
    wished = grid
    needed = taken = surface_bytes(points, grid)
    while taken > 1e6 * megabytes:
        if grid.cell > max(bounds.size):
            raise InputError(f"no surface fits into {megabytes:g} MB; allow more megabytes")
        grid = VoxelGrid.covering(bounds, COARSER * grid.cell)
        taken = surface_bytes(points, grid)
    if grid is not wished:
        size = "too many cells" if math.isinf(needed) else f"{needed / 1e6:.0f} MB"
        warnings.warn(
            f"the surface would take {size} with cells of {wished.cell:.3g}; cells of {grid.cell:.3g} keep it within"
            f" {megabytes:g} MB; raise this limit (`megabytes`)",
            InputWarning,
            stacklevel=2,
        )
    return grid


def surface_bytes(points: Float[Tensor, "p 3"], grid: VoxelGrid) -> float:
    """Return the memory (bytes) of a surface from these points (metres, world); infinite if it has too many cells."""
    if math.prod(-(-count // BLOCK_SIDE) * BLOCK_SIDE for count in grid.shape) > MOST_CELLS:
        return math.inf
    return SURFEL_BYTES * len(grid.numbers(points).unique()) + index_bytes(block_levels(points, grid))


def _depths(images: Sequence[PosedDepthImage], opacity: float) -> list[tuple[PosedDepthImage, Float[Tensor, "p"]]]:
    """Return the images that show a surface, with the depths (metres) of the pixels that show it."""
    return [(posed, d) for posed in images if len(d := posed.image.depth[posed.solid(opacity)])]


def _median(values: Sequence[float]) -> float:
    return statistics.median(values) if values else 0.0
