"""Viewpoints for a field whose training images are unknown: cameras in free space that see the field's geometry."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import MatrixRows, StoredCamera, horizontal_axes
from bidnerf_core.fields import RadianceField, Rays, SceneBounds, device_of, render
from bidnerf_core.geometry import SE3, look_at

CAMERA = Intrinsics.from_hfov(70.0, 192, 192)
VIEWS = 48
"""Number of viewpoints."""
DIRECTIONS = 48
"""Number of rays from each place, evenly over the sphere."""


def viewpoints(
    field: RadianceField,
    bounds: SceneBounds,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    is_solid: bool = False,
) -> tuple[StoredCamera, ...]:
    """Return cameras that see the geometry of a field, placed all around an object or in free space within a room.

    ``up`` is the up direction in the images. The inside of an ``is_solid`` object does not count as free space,
    although rays hit nothing there. The result is deterministic.
    """
    generator = torch.Generator().manual_seed(0)
    lower, size = torch.tensor(bounds.lower), torch.tensor(bounds.size)
    places = lower + size * torch.rand((400, 3), generator=generator)
    distance = _distances(field, bounds, places)
    hit = distance > 0
    nearest = torch.where(hit, distance, torch.inf).quantile(0.1, dim=1)  # exceeded by nine out of ten rays
    # Closer to matter than this, little is visible; a place is inside a room or the like if most rays from it hit matter.
    free = (nearest > 0.04 * bounds.side) & (hit.float().mean(1) > 0.6)
    # An object with hollows (Lego: 0.09) has some such places, and a room (0.5) has many: it is viewed from inside.
    if not is_solid and float(free.float().mean()) > 0.2:
        poses = _within(places[free], distance[free], up)
    else:  # from all around the box, at a distance from which it fills the images
        centre = torch.tensor(bounds.centre, dtype=torch.float64)
        radius = 0.8 * math.dist(bounds.lower, bounds.upper) * math.hypot(CAMERA.fx, CAMERA.cx) / CAMERA.width
        poses = [look_at(centre + radius * direction, centre, up) for direction in sphere(VIEWS)]
    rows: list[MatrixRows] = [(*((a, b, c, d) for a, b, c, d in pose.matrix().tolist()),) for pose in poses]
    return tuple(StoredCamera(f"viewpoint-{n:03d}", CAMERA, row) for n, row in enumerate(rows))


@torch.no_grad()
def _distances(
    field: RadianceField, bounds: SceneBounds, places: Float[Tensor, "p 3"]
) -> Float[Tensor, "p d"]:
    """Return the distance at which each ray from ``places``, in evenly spread directions, hits geometry; 0 without a hit."""
    device = device_of(field)
    origins = places[:, None].expand(-1, DIRECTIONS, 3).reshape(-1, 3).to(device)
    towards = sphere(DIRECTIONS).float().expand(len(places), -1, -1).reshape(-1, 3).to(device)
    near = torch.full_like(origins[:, 0], bounds.near)
    seen = render(field, Rays(origins, towards, near, torch.full_like(near, bounds.far)), bounds.background)
    # A ray of less opacity hits nothing solid.
    found = torch.where(seen.opacity > 0.8, seen.distance / seen.opacity.clamp(min=0.8), 0)
    return found.cpu().reshape(len(places), -1)


def _within(
    places: Float[Tensor, "p 3"], distance: Float[Tensor, "p d"], up: tuple[float, float, float]
) -> list[SE3]:
    """Return poses at free positions far from each other, facing the directions with the most distant geometry."""
    directions, vertical = sphere(DIRECTIONS), torch.tensor(up, dtype=torch.float64)
    level = (directions @ vertical).abs() < 0.75  # neither the ceiling nor the floor
    second, first = horizontal_axes(vertical)
    a, b = directions @ first, -directions @ second
    sectors = a > b.abs(), b >= a.abs(), -a > b.abs(), -b >= a.abs()
    poses = []
    for number in _spread(places, VIEWS // 4):
        # In each of four sectors about the vertical, the direction with the farthest matter: it shows most.
        for sector in sectors:
            allowed = sector & level & (distance[number] > 0)
            if bool(allowed.any()):
                ray = int(torch.where(allowed, distance[number], -1).argmax())
                eye = places[number].double()
                poses.append(look_at(eye, eye + directions[ray], up))
    return poses


def _spread(places: Float[Tensor, "p 3"], count: int) -> list[int]:
    """Return the indices of positions far from each other (farthest-point sampling)."""
    chosen = [int((places - places.mean(0)).norm(dim=-1).argmin())]
    away = (places - places[chosen[0]]).norm(dim=-1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (places - places[chosen[-1]]).norm(dim=-1))
    return chosen


def sphere(count: int) -> Float[Tensor, "n 3"]:
    """Return ``count`` unit directions spread evenly over the sphere (Fibonacci lattice), in float64."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * number / count
    azimuth, flat = number * math.pi * (3 - math.sqrt(5)), (1 - z * z).sqrt()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), z], dim=-1)
