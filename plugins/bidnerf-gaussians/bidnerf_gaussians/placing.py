"""Initial placement of Gaussians for training: on measured depth, on landmarks, within silhouettes, else anywhere."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Generator, Tensor

from bidnerf_core.carving import occupied_voxels
from bidnerf_core.fields import SceneBounds, VoxelGrid
from bidnerf_core.frames import View
from bidnerf_gaussians.field import GaussiansField
from bidnerf_gaussians.gaussians import Gaussians
from bidnerf_gaussians.spherical_harmonics import C0

OPACITY = 0.1
"""Initial opacity of a Gaussian, as in the original 3DGS code; larger on measured points."""
MEASURED_OPACITY = 0.5
NEIGHBOURS = 3
"""Number of neighbours whose mean distance is the initial width of a Gaussian."""


def first_gaussians(field: GaussiansField, views: Sequence[View], unit: float, generator: Generator) -> Gaussians:
    """Return as many Gaussians as the field has, placed on what the views measured, and the rest where matter can be."""
    count, bounds = len(field.means), field.bounds
    points, colours = _measured(views, count, generator)
    known = len(points)
    more = _anywhere(views, bounds, count - known, generator)
    means = torch.cat([points, more])
    rgb = torch.cat([colours, torch.full_like(more, 0.5)])
    opacity = torch.cat([torch.full((known,), MEASURED_OPACITY), torch.full((count - known,), OPACITY)])
    harmonics = torch.zeros(count, field.harmonics.shape[1], 3)
    harmonics[:, 0] = (rgb - 0.5) / C0
    quaternions = torch.zeros(count, 4)
    quaternions[:, 0] = 1
    return Gaussians(means, _widths(means, unit).log()[:, None].expand(-1, 3), quaternions, opacity.logit(), harmonics)


def _widths(means: Float[Tensor, "n 3"], unit: float) -> Float[Tensor, "n"]:
    """Return the mean distance of each point from its nearest neighbours (metres), within limits."""
    if len(means) <= NEIGHBOURS:
        return torch.full((len(means),), unit)
    distances, _ = cKDTree(means.numpy()).query(means.numpy(), k=NEIGHBOURS + 1)
    found = torch.from_numpy(np.asarray(distances[:, 1:].mean(-1), dtype=np.float32))
    return found.clamp(0.1 * unit, 4 * unit)


def _measured(
    views: Sequence[View], most: int, generator: Generator
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3"]]:
    """Return at most ``most`` points (metres, world) at which sensors or landmarks measured depth, and their colours."""
    each = max(1, math.ceil(2 * most / max(1, len(views))))
    points, colours = [torch.zeros(0, 3)], [torch.zeros(0, 3)]
    for view in views:
        frame = view.frame
        pixels, distance = _with_distance(view, each, generator)
        if not len(pixels):
            continue
        ray = torch.nn.functional.normalize(frame.intrinsics.unproject(pixels), dim=-1)
        T = view.T_ref_camera.to("cpu", torch.float64)
        points.append(T.apply(ray.double() * distance[:, None].double()).float())
        column = pixels[:, 0].long().clamp(0, frame.intrinsics.width - 1)
        row = pixels[:, 1].long().clamp(0, frame.intrinsics.height - 1)
        colours.append(frame.rgb.cpu()[row, column])
    found, rgb = torch.cat(points), torch.cat(colours)
    chosen = torch.randperm(len(found), generator=generator)[:most]
    return found[chosen], rgb[chosen]


def _with_distance(view: View, most: int, generator: Generator) -> tuple[Float[Tensor, "p 2"], Float[Tensor, "p"]]:
    """Return pixels of a view with their distance along the ray (metres)."""
    frame = view.frame
    if frame.depth is not None and bool((frame.depth > 0).any()):
        depth = frame.depth.cpu()
        where = (depth > 0).nonzero()
        where = where[torch.randperm(len(where), generator=generator)[:most]]
        pixels = where.flip(-1).float() + 0.5
        length = torch.linalg.vector_norm(frame.intrinsics.unproject(pixels), dim=-1)
        return pixels, depth[where[:, 0], where[:, 1]] * length
    if view.landmarks is not None and len(view.landmarks.distance):
        return view.landmarks.pixels.cpu().float(), view.landmarks.distance.cpu().float()
    return torch.zeros(0, 2), torch.zeros(0)


def _anywhere(views: Sequence[View], bounds: SceneBounds, count: int, generator: Generator) -> Float[Tensor, "n 3"]:
    """Return random points (metres, world) that the views do not show to be empty."""
    lower, size = torch.tensor(bounds.lower), torch.tensor(bounds.size)
    if count <= 0:
        return torch.zeros(0, 3)
    within = torch.rand((count, 3), generator=generator)
    if bounds.contracted:
        return lower + size * (within * 2 - 0.5)
    grid = VoxelGrid.cube(bounds, 96)  # in which silhouettes are carved
    held = occupied_voxels(views, grid)
    cells = (held & ~_surrounded(held)).nonzero()
    if not len(cells):
        return lower + size * within
    chosen = cells[torch.randint(len(cells), (count,), generator=generator)]
    corner, extent = torch.tensor(grid.lower), torch.tensor(grid.upper) - torch.tensor(grid.lower)
    return corner + (chosen + within) / torch.tensor(grid.shape) * extent


def _surrounded(held: Tensor) -> Tensor:
    """Return which cells have only occupied neighbours, so that no camera sees them."""
    empty = torch.nn.functional.max_pool3d((~held)[None, None].float(), 3, stride=1, padding=1)
    return empty[0, 0] == 0
