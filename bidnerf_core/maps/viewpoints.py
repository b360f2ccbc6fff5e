"""Viewpoints for a field whose training images are unknown: cameras that see its matter from free space."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import StoredCamera
from bidnerf_core.fields import RadianceField, Rays, SceneBounds, device_of, render
from bidnerf_core.geometry import SE3, look_at

SIZE = 192
"""Width and height of an image in pixels."""
FIELD_OF_VIEW = 70.0  # degrees
VIEWS = 48
"""Number of viewpoints."""
PLACES = 400
"""Number of random places in the box that are tried."""
DIRECTIONS = 48
"""Number of rays from each place, evenly over the sphere."""
SOLID = 0.8
"""Opacity above which a ray hits something."""
CLEARANCE = 0.04
"""Smallest distance from matter, relative to the box's longest side; closer up, little is visible."""
ENCLOSED = 0.6
"""Fraction of the rays from a place that hit matter above which it is inside a room or the like."""
ROOMY = 0.2
"""Fraction of the places in the box that must be free and enclosed for the scene to be viewed from inside. An
object with hollows (Lego: 0.09) has some such places, and a room (0.5) has many."""


@dataclass(frozen=True, eq=False)
class _Tried:
    """Places in a field and what rays from them hit."""

    places: Float[Tensor, "p 3"]
    share: Float[Tensor, "p"]  # of rays that hit matter
    nearest: Float[Tensor, "p"]  # metres: exceeded by nine out of ten rays
    distance: Float[Tensor, "p d"]  # metres; 0 where a ray hits nothing


def viewpoints(
    field: RadianceField, bounds: SceneBounds, up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    is_solid: bool = False,
) -> tuple[StoredCamera, ...]:  # fmt: skip
    """Return cameras that see the matter of a field: from all around an object, or from free places within a
    room.

    ``up`` is the upward direction in the images. The inside of an ``is_solid`` object is not free, although
    rays hit nothing there. Deterministic.
    """
    generator = torch.Generator().manual_seed(0)
    lower, size = torch.tensor(bounds.lower), torch.tensor(bounds.size)
    tried = _try(field, bounds, lower + size * torch.rand((PLACES, 3), generator=generator))
    free = (tried.nearest > CLEARANCE * bounds.side) & (tried.share > ENCLOSED)
    is_room = not is_solid and float(free.float().mean()) > ROOMY
    poses = _within(tried, free, up) if is_room else _around(bounds, up)
    focal = SIZE / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
    camera = Intrinsics(focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE)
    return tuple(
        StoredCamera(f"viewpoint-{number:03d}", camera, _rows(pose)) for number, pose in enumerate(poses)
    )


def _rows(pose: SE3) -> tuple[tuple[float, float, float, float], ...]:
    return tuple((r[0], r[1], r[2], r[3]) for r in pose.matrix().tolist())


@torch.no_grad()
def _try(field: RadianceField, bounds: SceneBounds, places: Float[Tensor, "p 3"]) -> _Tried:
    directions = sphere(DIRECTIONS).float()
    device = device_of(field)
    origins = places[:, None].expand(-1, DIRECTIONS, 3).reshape(-1, 3).to(device)
    towards = directions.expand(len(places), -1, -1).reshape(-1, 3).to(device)
    near = torch.full_like(origins[:, 0], bounds.near)
    seen = render(field, Rays(origins, towards, near, torch.full_like(near, bounds.far)), bounds.background)
    solid = seen.opacity > SOLID
    distance = (
        torch.where(solid, seen.distance / seen.opacity.clamp(min=SOLID), 0).cpu().reshape(len(places), -1)
    )
    met = torch.where(distance > 0, distance, torch.inf)
    return _Tried(places, (distance > 0).float().mean(1), met.quantile(0.1, dim=1), distance)


def _within(tried: _Tried, free: Tensor, up: tuple[float, float, float]) -> list[SE3]:
    """Return views from free places far from each other, each in the directions in which there is most to see."""
    places, distance = tried.places[free], tried.distance[free]
    directions = sphere(DIRECTIONS)
    level = (
        directions @ torch.tensor(up, dtype=torch.float64)
    ).abs() < 0.75  # neither the ceiling nor the floor
    chosen = _spread(places, VIEWS // 4)
    poses = []
    for number in chosen:
        # In each of four sectors about the vertical, the direction with the farthest matter: it shows most.
        for sector in _sectors(directions, up):
            allowed = sector & level & (distance[number] > 0)
            if bool(allowed.any()):
                ray = int(torch.where(allowed, distance[number], -1).argmax())
                eye = places[number].double()
                poses.append(look_at(eye, eye + directions[ray], up))
    return poses


def _spread(places: Float[Tensor, "p 3"], count: int) -> list[int]:
    """Return the indices of places far from each other (farthest-point sampling)."""
    chosen = [int((places - places.mean(0)).norm(dim=-1).argmin())]
    away = (places - places[chosen[0]]).norm(dim=-1)
    while len(chosen) < min(count, len(places)):
        chosen.append(int(away.argmax()))
        away = torch.minimum(away, (places - places[chosen[-1]]).norm(dim=-1))
    return chosen


def _sectors(directions: Float[Tensor, "d 3"], up: tuple[float, float, float]) -> list[Tensor]:
    vertical = torch.tensor(up, dtype=torch.float64)
    first = torch.linalg.cross(vertical, _not_along(vertical))
    second = torch.linalg.cross(vertical, first)
    a, b = directions @ first, directions @ second
    return [(a > b.abs()), (b >= a.abs()), (-a > b.abs()), (-b >= a.abs())]


def _not_along(vertical: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    unit = torch.zeros_like(vertical)
    unit[int(vertical.abs().argmin())] = 1
    return unit


def _around(bounds: SceneBounds, up: tuple[float, float, float]) -> list[SE3]:
    """Return views from all around the box, at a distance from which it fills them."""
    centre = torch.tensor(bounds.centre, dtype=torch.float64)
    radius = math.dist(bounds.lower, bounds.upper) / 2 / math.sin(math.radians(FIELD_OF_VIEW / 2)) * 0.8
    return [look_at(centre + radius * direction, centre, up) for direction in sphere(VIEWS)]


def sphere(count: int) -> Float[Tensor, "n 3"]:
    """Return ``count`` unit directions evenly over the sphere (Fibonacci), in float64."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * number / count
    azimuth, flat = number * math.pi * (3 - math.sqrt(5)), (1 - z * z).sqrt()
    return torch.stack([flat * azimuth.cos(), flat * azimuth.sin(), z], dim=-1)
