"""Closed-form scenes with exact depth.

A scene is a list of painted solids. Its colour does not depend on the viewing direction, so any radiance field can learn the
scene; its depth is exact, so any error is that of the field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.scenes.primitives import Primitive
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import SceneBounds
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, look_at


@dataclass(frozen=True, eq=False)
class ClosedFormScene:
    """Painted Lambertian solids under one distant light, without cast shadows."""

    primitives: Sequence[Primitive]
    bounds: SceneBounds
    name: str
    light: tuple[float, float, float] = (0.4, -0.5, 0.77)  # direction towards the light, world
    contrast: float = 0.6  # how much darker a surface is if it faces away from the light

    @torch.no_grad()
    def intersect(
        self, origins: Float[Tensor, "*#r 3"], directions: Float[Tensor, "*r 3"]
    ) -> tuple[Float[Tensor, "*r"], Float[Tensor, "*r 3"]]:
        """Intersect rays (metres, world; unit ``directions``) with the first surface. All rays may share one origin.

        Returns the distance (metres) and the lit colour; inf and the background colour if nothing is hit.
        """
        rays = directions.reshape(-1, 3).T.contiguous()
        shared = origins.numel() == 3
        starts = (origins if shared else origins.expand_as(directions)).to(rays).reshape(-1, 3).T
        distance, owner = self._nearest(starts, rays)
        rgb = rays.new_tensor(self.bounds.background).repeat(rays.shape[1], 1)
        order, counts = owner.argsort(), torch.bincount(owner.long() + 1, minlength=len(self.primitives) + 1)
        for primitive, own in zip(self.primitives, order.split(counts.tolist())[1:], strict=True):
            if len(own):
                towards = rays[:, own]
                points = (starts if shared else starts[:, own]) + distance[own] * towards
                paint, outward = primitive.surface(points)
                light = torch.nn.functional.normalize(paint.new_tensor(self.light), dim=0)
                normal = torch.where((outward * towards.T).sum(-1, keepdim=True) > 0, -outward, outward)
                rgb[own] = paint * (1 - self.contrast * (1 - normal @ light) / 2)[:, None]
        return distance.reshape(directions.shape[:-1]), rgb.reshape_as(directions)

    @torch.no_grad()
    def render(self, intrinsics: Intrinsics, T_world_camera: SE3, name: str = "", supersample: int = 2) -> Frame:
        """Render an image from a pose: colour and coverage are averaged over each pixel, depth is exact at its centre."""
        steps = (torch.arange(supersample) + 0.5) / supersample - 0.5
        offsets = torch.cartesian_prod(steps, steps).reshape(-1, 1, 1, 2)
        rays, _ = _world_rays(intrinsics, T_world_camera, intrinsics.pixel_centres() + offsets)
        met, rgb = self.intersect(T_world_camera.translation.float(), rays)
        centres, length = _world_rays(intrinsics, T_world_camera, intrinsics.pixel_centres(torch.float64))
        distance, _ = self._nearest(
            T_world_camera.translation.to(centres)[:, None], centres.reshape(-1, 3).T.contiguous()
        )
        return Frame(
            name or self.name,
            rgb.mean(0),
            intrinsics,
            (torch.where(distance.isfinite(), distance, 0).reshape_as(length) / length).float(),
            met.isfinite().float().mean(0),
        )

    def _nearest(self, origins: Float[Tensor, "3 #n"], rays: Float[Tensor, "3 n"]) -> tuple[Tensor, Tensor]:
        """Return the distance to the first surface (metres; inf: none) and the index of its primitive (-1: none)."""
        distance = torch.full_like(rays[0], torch.inf)
        owner = torch.full_like(rays[0], -1, dtype=torch.int16)
        for i, primitive in enumerate(self.primitives):
            # Of rays from a single origin, only those in the cone around the primitive's ball may meet it.
            towards = primitive.T_world_shape.translation.to(rays) - origins[:, 0]
            beyond = float(towards @ towards) - (primitive.shape.reach * 1.01 + 1e-3) ** 2
            candidates = torch.arange(rays.shape[1])
            if origins.shape[1] == 1 and beyond > 0:
                candidates = (towards @ rays > beyond**0.5).nonzero()[:, 0]
            if len(candidates):
                starts = origins if origins.shape[1] == 1 else origins[:, candidates]
                found = primitive.distance(starts, rays[:, candidates])
                closer = found < distance[candidates]
                winners = candidates[closer]
                distance[winners], owner[winners] = found[closer], i
        return distance, owner


def views(scene: ClosedFormScene, intrinsics: Intrinsics, poses: Sequence[SE3]) -> list[View]:
    """Return views of a scene rendered from ``poses`` (``T_world_camera``); the frames are named 0000, 0001 and so on."""
    return [View(scene.render(intrinsics, T, f"{i:04d}"), T) for i, T in enumerate(poses)]


def _world_rays(intrinsics: Intrinsics, T_world_camera: SE3, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit directions (... 3; world) through ``pixels``, and the length of each at z = 1 (camera frame)."""
    rays = intrinsics.unproject(pixels)
    length = torch.linalg.vector_norm(rays, dim=-1)
    return T_world_camera.to(rays).rotate(rays / length[..., None]), length


GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
"""Angle (rad) whose successive multiples fill a circle evenly, however many there are."""


def orbit(
    radius: float,
    count: int,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    elevation: tuple[float, float] = (5.0, 80.0),
    seed: int = 0,
) -> list[SE3]:
    """Return poses (``T_world_camera``) that look at ``centre``, spread evenly over a sphere around it (Fibonacci lattice).

    ``radius`` is in metres. ``elevation`` is the range in degrees above the horizon; (-90, 90) is the whole sphere. ``seed``
    rotates the spiral, so that orbits with different seeds share no position.
    """
    turn, shift = torch.rand(2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).tolist()
    low, high = (math.sin(math.radians(e)) for e in elevation)
    poses: list[SE3] = []
    for i in range(count):
        z = low + (high - low) * (i + shift) / count
        azimuth, flat = i * GOLDEN_ANGLE + 2 * math.pi * turn, math.sqrt(max(0.0, 1 - z * z))
        offset = (flat * math.cos(azimuth), flat * math.sin(azimuth), z)
        poses.append(look_at([c + radius * o for c, o in zip(centre, offset, strict=True)], centre))
    return poses


def look_around(bounds: SceneBounds, count: int, seed: int = 0, spread: float = 0.5) -> list[SE3]:
    """Return poses (``T_world_camera``) at head height in a room, in all compass directions, tilted slightly up or down.

    Each camera stands about ``spread`` of the way from the middle of the room to the wall behind it, to see
    much of the room.
    """
    generator = torch.Generator().manual_seed(seed)
    lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in (bounds.lower, bounds.upper))
    middle, half = (lower + upper) / 2, (upper - lower) / 2
    poses: list[SE3] = []
    turn = 2 * math.pi * torch.rand((), generator=generator, dtype=torch.float64).item()
    for chance in torch.rand((count, 4), generator=generator, dtype=torch.float64):
        azimuth = turn + len(poses) * GOLDEN_ANGLE
        forward = middle.new_tensor([math.cos(azimuth), math.sin(azimuth), 0.0])
        sideways = (chance[:3] - 0.5) * middle.new_tensor([0.4, 0.4, 0.3])
        eye = middle + half * (sideways - spread * forward + middle.new_tensor([0.0, 0.0, 0.15]))
        poses.append(look_at(eye, eye + forward + middle.new_tensor([0.0, 0.0, 0.15 - 0.6 * chance[3].item()])))
    return poses
