"""Depth on rays of its own: a lidar beside the camera, or the few points that structure from motion found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.field import Rays, SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.pixels import all_pixels, observe
from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class DepthRays:
    """Half-lines of a reference frame, and how far along each something was met. They say nothing of colour."""

    origins: Float[Tensor, "n 3"]  # metres, reference frame
    directions: Float[Tensor, "n 3"]  # unit, reference frame
    distance: Float[Tensor, "n"]  # metres along the ray, > 0

    def __post_init__(self) -> None:
        if len(self.distance) == 0:
            raise InputError("depth rays: nothing was measured, expected at least one finite point in front")

    def __len__(self) -> int:
        return len(self.distance)

    @staticmethod
    def from_points(points: Float[Tensor, "n 3"], T_ref_sensor: SE3) -> DepthRays:
        """What a sensor at the origin of its frame measured, as ``points`` (metres) of that frame.

        Points that are not finite or lie at the origin are the returns that a lidar did not get; they are left out.
        """
        points = points.to(torch.float64)
        distance = torch.linalg.vector_norm(points, dim=-1)
        met = distance.isfinite() & (distance > 0)
        T = T_ref_sensor.to(points)
        directions = T.rotate(points[met] / distance[met][:, None])
        return DepthRays(T.translation.expand_as(directions), directions, distance[met])

    @staticmethod
    def from_views(views: Sequence[View]) -> DepthRays:
        """Every pixel whose depth ``views`` measured: where those are few, pixels drawn anywhere would miss them."""
        parts = [observe(view, all_pixels(view.frame), torch.float64, "cpu") for view in views]
        return DepthRays(
            torch.cat([p.origins[p.distance > 0] for p in parts]),
            torch.cat([p.directions[p.distance > 0] for p in parts]),
            torch.cat([p.distance[p.distance > 0] for p in parts]),
        )

    @staticmethod
    def joined(parts: Sequence[DepthRays]) -> DepthRays:
        """All of them, of one reference frame."""
        return DepthRays(
            torch.cat([part.origins for part in parts]),
            torch.cat([part.directions for part in parts]),
            torch.cat([part.distance for part in parts]),
        )

    def drawn(
        self,
        count: int,
        generator: Generator,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> DepthRays:
        """``count`` of them with replacement, each as likely as any other; or all, where there are no more."""
        parts = (self.origins, self.directions, self.distance)
        if count < len(self):
            index = torch.randint(len(self), (count,), generator=generator).to(self.distance.device)
            parts = (self.origins[index], self.directions[index], self.distance[index])
        return DepthRays(*(part.to(device=device, dtype=dtype) for part in parts))

    def rays(self, T_world_ref: SE3, bounds: SceneBounds) -> Rays:
        """The half-lines where ``T_world_ref`` puts them, limited to the scene; differentiable in the transform."""
        T = T_world_ref.to(self.origins)
        return bounds.rays(T.apply(self.origins), T.rotate(self.directions))

    @property
    def points(self) -> Float[Tensor, "n 3"]:
        """Where something was met, in the reference frame."""
        return self.origins + self.distance[:, None] * self.directions
