"""Baking: the surface of any field, as rendered or measured depth shows it from many places."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.field import RadianceField, SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.mapping.surface_map import SurfaceMap, nearest_surfels
from bidnerf_core.mapping.surfels import fused, merged
from bidnerf_core.rendering import RenderedImage, render_image
from bidnerf_core.se3 import SE3

WITNESSES = 8
"""Other views that are asked about each point."""


@dataclass(frozen=True)
class BakeConfig:
    """How a surface is baked."""

    rays: int = 300_000  # rendered in all, shared out equally among the views
    cells: int = 4_000_000  # of the grid, at most
    opacity: float = 0.9  # what stops less of a ray is no surface
    agreement: int = 2  # other views that must see a point where it is

    def __post_init__(self) -> None:
        for name, least, most in (("rays", 1000, 10**9), ("cells", 1000, 10**9), ("agreement", 0, WITNESSES)):
            if not least <= getattr(self, name) <= most:
                raise InputError(f"{name} is {getattr(self, name)}, expected {least} to {most}")
        if not 0 < self.opacity < 1:
            raise InputError(f"opacity is {self.opacity}, expected a share between 0 and 1")


@dataclass(frozen=True, eq=False)
class Sight:
    """An image with depth and its place."""

    intrinsics: Intrinsics
    T_world_camera: SE3
    image: RenderedImage
    measured: bool = False  # by a sensor, whose opacity tells no more than where it measured


def bake(
    field: RadianceField,
    bounds: SceneBounds,
    cameras: Sequence[tuple[Intrinsics, SE3]],
    views: Sequence[View] = (),
    config: BakeConfig = BakeConfig(),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SurfaceMap:
    """Take the depth that ``views`` measured, and render it from ``cameras`` (T_world_camera); keep the points that
    several of these agree on, fuse them, and index them by a grid.

    Measured depth is closer to the truth than a field that was trained on it; where none was measured, the field tells.
    Raises ``InputError`` where there is nothing to agree on.
    """
    total = len(views) + len(cameras)
    if not total:
        raise InputError("nothing to bake a surface from: expected at least one camera or view")
    pixels = config.rays / total
    sights = [_measured(view, pixels) for view in views]
    for number, (intrinsics, T) in enumerate(cameras, start=1):
        small = _shrunk(intrinsics, pixels)
        sights.append(Sight(small, T.to("cpu", torch.float64), render_image(field, small, T, bounds)))
        progress(len(views) + number, total)
    return surface_of(sights, bounds, config)


def surface_of(sights: Sequence[Sight], bounds: SceneBounds, config: BakeConfig) -> SurfaceMap:
    """The surface that images with depth show."""
    cell, (x, y, z) = _grid(bounds, config.cells)
    points, rgb = _agreed_points(sights, 2 * cell, config)
    place = ((points - torch.tensor(bounds.lower)) / cell).floor().long()
    inside = ((place >= 0) & (place < torch.tensor((x, y, z)))).all(-1)
    numbers = (place[inside] * torch.tensor((y * z, z, 1))).sum(-1)
    occupied, (positions, colours) = merged(numbers, points[inside], rgb[inside])
    nearest = nearest_surfels(occupied, (x, y, z))
    keyframes = torch.stack([s.T_world_camera.matrix() for s in sights])
    return SurfaceMap(fused(positions, colours), bounds.lower, cell, nearest, keyframes)


def _grid(bounds: SceneBounds, cells: int) -> tuple[float, tuple[int, int, int]]:
    """Side of a cubic cell (metres), and how many of them, ``cells`` at most, fill the box."""
    cell = (math.prod(bounds.size) / cells) ** (1 / 3)
    while True:
        x, y, z = (math.ceil(side / cell) for side in bounds.size)
        if x * y * z <= cells:
            return cell, (x, y, z)
        cell *= 1.01  # the last of each row sticks out


def _measured(view: View, pixels: float) -> Sight:
    """What a view measured, thinned out to about ``pixels``."""
    frame = view.frame
    small = _shrunk(frame.intrinsics, pixels)
    scale = torch.tensor([frame.intrinsics.width / small.width, frame.intrinsics.height / small.height])
    columns, rows = (small.pixel_centres() * scale).long().unbind(-1)
    depth = torch.zeros(rows.shape) if frame.depth is None else frame.depth.cpu()[rows, columns]
    depth = torch.where(depth.isfinite() & (depth > 0), depth, 0)
    image = RenderedImage(frame.rgb.cpu()[rows, columns], depth, (depth > 0).to(depth))
    return Sight(small, view.T_ref_camera.to("cpu", torch.float64), image, True)


def _shrunk(intrinsics: Intrinsics, pixels: float) -> Intrinsics:
    return intrinsics.scaled(min(1.0, math.sqrt(pixels / (intrinsics.width * intrinsics.height))))


def _agreed_points(
    sights: Sequence[Sight], tolerance: float, config: BakeConfig
) -> tuple[Float[Tensor, "p 3"], Float[Tensor, "p 3"]]:
    """World points and colours that other views see at the same place (within ``tolerance``, metres)."""
    points, colours = [], []
    for number, sight in enumerate(sights):
        solid = (sight.image.opacity > config.opacity) & (sight.image.depth > 0)
        rays = sight.intrinsics.unproject(sight.intrinsics.pixel_centres())
        seen = sight.T_world_camera.to(torch.float32).apply(rays[solid] * sight.image.depth[solid][:, None])
        kept = _agreed(seen, number, sights, tolerance, config.agreement)
        points.append(seen[kept])
        colours.append(sight.image.rgb[solid][kept])
    return torch.cat(points), torch.cat(colours)


def _agreed(
    points: Float[Tensor, "p 3"], number: int, sights: Sequence[Sight], tolerance: float, needed: int
) -> Bool[Tensor, "p"]:
    """More views see a point than see through it, and enough of them."""
    agree, against = (torch.zeros(len(points), dtype=torch.int32) for _ in range(2))
    others = _witnesses(number, sights)
    for other in others:
        beyond = _beyond(points, sights[other])
        agree += (beyond.abs() <= tolerance).int()
        against += (beyond > tolerance).int()
    return (agree >= min(needed, len(others))) & (agree >= against)


def _witnesses(number: int, sights: Sequence[Sight]) -> list[int]:
    """The views whose cameras look most alike: they are the likeliest to see the same."""
    here = sights[number].T_world_camera
    centres = torch.stack([s.T_world_camera.translation for s in sights])
    axes = torch.stack([s.T_world_camera.rotation[:, 2] for s in sights])
    away = torch.linalg.vector_norm(centres - here.translation, dim=-1)
    turned = 1 - axes @ here.rotation[:, 2]
    order = (away / away.mean().clamp(min=1e-9) + turned).argsort().tolist()
    return [i for i in order if i != number][:WITNESSES]


def _beyond(points: Float[Tensor, "p 3"], sight: Sight) -> Float[Tensor, "p"]:
    """How much farther than a point its line of sight ends, metres of depth; NaN where the view does not tell."""
    local = sight.T_world_camera.to(torch.float32).inverse().apply(points)
    u, v = sight.intrinsics.project(local).unbind(-1)
    height, width = sight.image.depth.shape
    within = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    index = torch.where(within, v.floor() * width + u.floor(), 0).long()
    depth = sight.image.depth.view(-1)[index]
    nothing = sight.image.opacity.view(-1)[index] < 0.5
    # A rendered view sees through to the background there, a sensor does not say what it sees.
    told = torch.where(nothing, torch.nan if sight.measured else torch.inf, depth) - local[:, 2]
    return torch.where(within, told, torch.nan)
