"""Closed-form scenes with exact depth.

A scene is a list of painted solids. Its colour does not depend on the viewing direction, so any radiance field can learn
it; its depth is exact, so any error is the field's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.scenes.primitives import Primitive


@dataclass(frozen=True, eq=False)
class Hits:
    """The first surface on each ray."""

    distance: Float[Tensor, "*r"]  # metres along the ray; inf if nothing is hit
    rgb: Float[Tensor, "*r 3"]  # lit; the background's if nothing is hit
    normal: Float[Tensor, "*r 3"]  # unit, world, on the ray's side of the surface; 0 if nothing is hit


@dataclass(frozen=True, eq=False)
class ClosedFormScene:
    """Painted Lambertian solids under one distant light, without cast shadows."""

    primitives: Sequence[Primitive]
    bounds: SceneBounds
    name: str
    light: tuple[float, float, float] = (0.4, -0.5, 0.77)  # direction towards the light, world
    contrast: float = 0.6  # how much darker a surface is if it faces away from the light

    @torch.no_grad()
    def intersect(self, origins: Float[Tensor, "*#r 3"], directions: Float[Tensor, "*r 3"]) -> Hits:
        """Return the first surface along unit ``directions`` (metres, world). One origin may be shared by all rays."""
        rays = directions.reshape(-1, 3).T.contiguous()
        shared = origins.numel() == 3
        starts = (origins if shared else origins.expand_as(directions)).to(rays).reshape(-1, 3).T
        distance, owner = self._nearest(starts, rays)
        rgb = rays.new_tensor(self.bounds.background).repeat(rays.shape[1], 1)
        normal = torch.zeros_like(rgb)
        order, counts = owner.argsort(), torch.bincount(owner.long() + 1, minlength=len(self.primitives) + 1)
        for primitive, own in zip(self.primitives, order.split(counts.tolist())[1:], strict=True):
            if len(own):
                towards = rays[:, own]
                points = (starts if shared else starts[:, own]) + distance[own] * towards
                rgb[own], normal[own] = self._lit(primitive, points, towards)
        return Hits(
            distance.reshape(directions.shape[:-1]), rgb.reshape_as(directions), normal.reshape_as(directions)
        )

    @torch.no_grad()
    def render(
        self, intrinsics: Intrinsics, T_world_camera: SE3, name: str = "", supersample: int = 2
    ) -> Frame:
        """Render an image from a pose: colour and coverage are averaged over each pixel, depth is exact at its centre."""
        if supersample < 1:
            raise InputError(f"supersample is {supersample}", expected="at least 1")
        steps = (torch.arange(supersample) + 0.5) / supersample - 0.5
        offsets = torch.cartesian_prod(steps, steps).reshape(-1, 1, 1, 2)
        rays, _ = _world_rays(intrinsics, T_world_camera, intrinsics.pixel_centres() + offsets)
        hits = self.intersect(T_world_camera.translation.float(), rays)
        centres, length = _world_rays(intrinsics, T_world_camera, intrinsics.pixel_centres(torch.float64))
        distance, _ = self._nearest(
            T_world_camera.translation.to(centres)[:, None], centres.reshape(-1, 3).T.contiguous()
        )
        depth = (torch.where(distance.isfinite(), distance, 0).reshape_as(length) / length).float()
        alpha = hits.distance.isfinite().float().mean(0)
        return Frame(name or self.name, hits.rgb.mean(0), intrinsics, depth, alpha)

    def _nearest(self, origins: Float[Tensor, "3 #n"], rays: Float[Tensor, "3 n"]) -> tuple[Tensor, Tensor]:
        """Return the distance to the first surface (metres; inf: none) and the index of its primitive (-1: none)."""
        distance = torch.full_like(rays[0], torch.inf)
        owner = torch.full_like(rays[0], -1, dtype=torch.int16)
        for i, primitive in enumerate(self.primitives):
            candidates = _may_meet(primitive, origins, rays)
            if len(candidates):
                starts = origins if origins.shape[1] == 1 else origins[:, candidates]
                found = primitive.distance(starts, rays[:, candidates])
                closer = found < distance[candidates]
                winners = candidates[closer]
                distance[winners], owner[winners] = found[closer], i
        return distance, owner

    def _lit(
        self, primitive: Primitive, points: Float[Tensor, "3 n"], towards: Float[Tensor, "3 n"]
    ) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        paint, outward = primitive.surface(points)
        light = torch.nn.functional.normalize(paint.new_tensor(self.light), dim=0)
        normal = torch.where((outward * towards.T).sum(-1, keepdim=True) > 0, -outward, outward)
        return paint * (1 - self.contrast * (1 - normal @ light) / 2)[:, None], normal


def views(scene: ClosedFormScene, intrinsics: Intrinsics, poses: Sequence[SE3]) -> list[View]:
    """Render the scene from each pose (``T_world_camera``); frames are named 0000, 0001 ..."""
    return [View(scene.render(intrinsics, T, f"{i:04d}"), T) for i, T in enumerate(poses)]


def _may_meet(primitive: Primitive, origins: Float[Tensor, "3 #n"], rays: Float[Tensor, "3 n"]) -> Tensor:
    """Return the indices of the rays that may hit the primitive: from a single origin, those in the cone
    around its ball.
    """
    towards = primitive.T_world_shape.translation.to(rays) - origins[:, 0]
    beyond = float(towards @ towards) - (primitive.shape.reach * 1.01 + 1e-3) ** 2
    if origins.shape[1] > 1 or beyond <= 0:
        return torch.arange(rays.shape[1])
    return (towards @ rays > beyond**0.5).nonzero()[:, 0]


def _world_rays(intrinsics: Intrinsics, T_world_camera: SE3, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit directions (... 3; world) through ``pixels``, and the length of each at z = 1 (camera frame)."""
    rays = intrinsics.unproject(pixels)
    length = torch.linalg.vector_norm(rays, dim=-1)
    return T_world_camera.to(rays).rotate(rays / length[..., None]), length
