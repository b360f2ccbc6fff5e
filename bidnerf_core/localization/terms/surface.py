"""Distances of measured points from the baked surface as a log likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import exposure_times
from bidnerf_core.fields import Observations
from bidnerf_core.frames import View
from bidnerf_core.localization.descend import Normal
from bidnerf_core.localization.states import DEPTH, MOTION, Sights, States, rays_by_camera, rays_through
from bidnerf_core.localization.terms.landmarks import MAD
from bidnerf_core.mapping import SurfaceMap

POINTS = 500
"""Number of points that are compared."""
INDEPENDENT = 10.0
"""Largest number of independent measurements among depths against the surface."""
DISC = 1.5
"""Radius of a surfel in cells: beyond it, a point does not lie on the surface."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Distances of measured points from the planes of the nearest surfels, metres."""

    surface: SurfaceMap
    sights: Sights  # (n) pixels of measured depth; rotation and translation are T_rig_camera
    z: Float[Tensor, "n"]  # metres, measured along the optical axis
    fixed: Float[Tensor, "n 3"]  # metres: points of another sensor in the camera's frame, for which z is 0
    noise: float  # metres

    @staticmethod
    def of(
        views: Sequence[View], rays: Observations | None, surface: SurfaceMap, seed: int
    ) -> Surface | None:
        """Draw measured points of ``views``, whose poses are relative to the last; None if there are too few."""
        generator, parts = torch.Generator().manual_seed(seed), []
        for view in views:
            depth = torch.zeros((0, 0)) if view.frame.depth is None else view.frame.depth.cpu()
            row, column = ((depth > 0) & depth.isfinite()).nonzero().unbind(-1)
            if view.frame.hidden is not None and len(row):
                shown = ~view.frame.hidden.cpu()[row, column]
                row, column = row[shown], column[shown]
            drawn = torch.randperm(len(row), generator=generator)[: -(-POINTS // len(views))]
            pixels = torch.stack([column[drawn], row[drawn]], -1).double() + 0.5
            camera, z = view.frame.intrinsics, depth[row[drawn], column[drawn]].double()
            times = exposure_times(pixels, camera) if len(views) == 1 else torch.zeros_like(z)
            parts.append(
                (
                    camera.unproject(pixels)[:, :2],
                    times,
                    z,
                    torch.zeros((len(z), 3)).double(),
                    view.T_ref_camera,
                )
            )
        if rays is not None and len(rays):
            points = rays.drawn(POINTS, generator, device="cpu").points.double()
            zero = torch.zeros(len(points), dtype=torch.float64)
            parts.append((points[:, :2] * 0, zero, zero, points, views[-1].T_ref_camera))
        image, times, z, fixed = (torch.cat([part[i] for part in parts]) for i in range(4))
        if len(z) < 50:
            return None
        R = torch.cat([part[4].rotation.double().cpu().expand(len(part[2]), 3, 3) for part in parts])
        t = torch.cat([part[4].translation.double().cpu().expand(len(part[2]), 3) for part in parts])
        return Surface(surface, Sights(image, times, R, t), z, fixed, 2 * surface.cell)

    def __call__(self, states: States) -> Normal:
        r, squared, normal, local, rays = self._offsets(states)
        # Geman-McClure: points of an occluder have almost no influence
        inlier = 1 / (1 + squared / (2 * self.noise) ** 2)
        share = INDEPENDENT / len(self.z)
        cost = share * 2 * (1 - inlier).sum(-1)
        weight = share * inlier.square() / self.noise**2
        rows = self._rows(states, normal, local, rays)
        return Normal(cost, ((weight * r)[..., None] * rows).sum(1), (rows * weight[..., None]).mT @ rows)

    def near(self, states: States) -> Float[Tensor, "h n"]:
        """Return how far each point is on the surface: its inlier weight."""
        return 1 / (1 + self._offsets(states)[1] / (3 * self.noise) ** 2)

    def fitted_noise(self, states: States) -> Surface:
        """Return the term with the noise of the points at the first state."""
        r, least = self._offsets(states[:1])[0].abs(), 0.25 * self.surface.cell
        return replace(self, noise=min(max(MAD * float(r.median()), least), 3 * self.noise))  # host

    def _offsets(self, states: States):
        rays, sights = rays_through(states, self.sights.image), self.sights
        local = rays * (self.z * states.nuisances[:, DEPTH, None].exp())[..., None] + self.fixed
        v, w = (states.nuisances[:, None, part].expand_as(local) for part in (slice(6, 9), slice(9, 12)))
        local = local + sights.times[:, None] * (v + torch.linalg.cross(w, local))
        rig = (sights.rotation @ local[..., None])[..., 0] + sights.translation
        world = states.T.translation[:, None] + rig @ states.T.rotation.mT
        index = self.surface.nearest(world.float())
        offset = world - self.surface.surfels.positions[index]
        normal = self.surface.surfels.normals[index].double()
        across = (offset * normal).sum(-1)
        along = (offset.square().sum(-1) - across.square()).clamp(min=0).sqrt()
        beyond = (along - DISC * self.surface.cell).clamp(min=0)
        return across, across.square() + beyond.square(), normal @ states.T.rotation, local, rays

    def _rows(self, states, normal, local, rays) -> Float[Tensor, "h n P"]:
        sights = self.sights
        rig = (sights.rotation @ local[..., None])[..., 0] + sights.translation
        by_pose = torch.cat([normal, torch.linalg.cross(rig, normal)], -1)
        own = (normal[..., None, :] @ sights.rotation)[..., 0, :]  # in the camera's frame
        scale = (self.z * states.nuisances[:, DEPTH, None].exp())[..., None]
        by_camera = (own[..., None] * rays_by_camera(rays, states)).sum(-2) * scale
        by_row = torch.cat([own, torch.linalg.cross(local, own)], -1)
        by_motion = by_row * sights.times[:, None] * states.deviation[:, None, MOTION]
        by_depth = (own * (local - self.fixed)).sum(-1, keepdim=True) * states.deviation[:, None, DEPTH:]
        return torch.cat([by_pose, by_camera, by_motion, by_depth], -1)
