"""Measured rays: colours and distances that sensors measured along half-lines in a reference frame.

One class represents the pixels of an RGB-D image, the returns of a lidar and the points of structure from
motion. ``coloured`` marks rays with a colour, and ``distance`` is 0 for rays without a measured distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.fields.contract import Rays, SceneBounds
from bidnerf_core.geometry import SE3


@dataclass(frozen=True, eq=False)
class Observations:
    """Half-lines in a reference frame with the colour and distance measured along them."""

    origins: Float[Tensor, "*p 3"]  # metres, reference frame
    directions: Float[Tensor, "*p 3"]  # unit, reference frame
    rgb: Float[Tensor, "*p 3"]  # in [0, 1]; 0 where not coloured
    distance: Float[Tensor, "*p"]  # metres along the ray, not z; 0 where nothing was measured
    coloured: Bool[Tensor, "*p"]  # whether a colour was measured

    @staticmethod
    def from_points(points: Float[Tensor, "n 3"], T_ref_sensor: SE3) -> Observations:
        """Return rays to ``points`` (metres), as measured by a sensor at the origin of their frame; float64.

        Points that are not finite or lie at the origin are a lidar's missing returns and are left out. Raises
        ``InputError`` if none is left.
        """
        points = points.to(torch.float64)
        distance = torch.linalg.vector_norm(points, dim=-1)
        measured = distance.isfinite() & (distance > 0)
        T = T_ref_sensor.to(points)
        directions = T.rotate(points[measured] / distance[measured][:, None])
        return Observations.of_depth(T.translation.expand_as(directions), directions, distance[measured])

    @staticmethod
    def of_depth(
        origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], distance: Float[Tensor, "n"]
    ) -> Observations:
        """Return rays along which only a distance (metres, > 0) was measured. Raises ``InputError`` if there are none."""
        if len(distance) == 0:
            raise InputError(
                "nothing was measured", where="depth rays", expected="at least one finite point in front"
            )
        coloured = torch.zeros(len(distance), dtype=torch.bool, device=distance.device)
        return Observations(origins, directions, torch.zeros_like(directions), distance, coloured)

    @staticmethod
    def joined(parts: Sequence[Observations]) -> Observations:
        """Concatenate the rays of ``parts``, which share a reference frame, along the first axis."""
        return Observations(
            *(torch.cat(values) for values in zip(*(part._tensors() for part in parts), strict=True))
        )

    @staticmethod
    def stacked(parts: Sequence[Observations]) -> Observations:
        """Stack parts with equal numbers of rays along a new first axis."""
        return Observations(
            *(torch.stack(values) for values in zip(*(part._tensors() for part in parts), strict=True))
        )

    def __len__(self) -> int:
        return len(self.distance)

    def __getitem__(self, index: Tensor | slice | None) -> Observations:
        """Return some of the rays, by index along the first axis or by a mask; None adds an axis of length 1."""
        return Observations(*(part[index] for part in self._tensors()))

    @property
    def measured(self) -> Bool[Tensor, "*p"]:
        """The mask of the rays along which a distance was measured."""
        return self.distance > 0

    @property
    def points(self) -> Float[Tensor, "*p 3"]:
        """The measured points (metres, reference frame); the ray's origin where no distance was measured."""
        return self.origins + self.distance[..., None] * self.directions

    def without_colour(self) -> Observations:
        """Return the rays along which a distance was measured, without colours. Raises ``InputError`` if there are none."""
        measured = self[self.measured]
        return Observations.of_depth(measured.origins, measured.directions, measured.distance)

    def gathered(self, index: Int[Tensor, "k m"]) -> Observations:
        """Return m rays from each row of rays of shape (k p), at ``index`` along the second axis."""
        wide = index[..., None].expand(*index.shape, 3)
        origins, directions, rgb = (
            part.gather(1, wide) for part in (self.origins, self.directions, self.rgb)
        )
        return Observations(
            origins, directions, rgb, self.distance.gather(1, index), self.coloured.gather(1, index)
        )

    def flattened(self) -> Observations:
        """Return these rays flattened to one axis."""
        origins, directions, rgb = (part.reshape(-1, 3) for part in (self.origins, self.directions, self.rgb))
        return Observations(origins, directions, rgb, self.distance.reshape(-1), self.coloured.reshape(-1))

    def repeated(self, times: int) -> Observations:
        """Repeat rays of shape (n) ``times`` times in sequence, for as many poses."""
        return Observations(*(part.expand(times, *part.shape).flatten(0, 1) for part in self._tensors()))

    def drawn(
        self,
        count: int,
        generator: Generator,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> Observations:
        """Draw ``count`` of the rays uniformly with replacement; return all of them if there are no more than that."""
        if count >= len(self):
            return self.to(device, dtype)
        index = torch.randint(len(self), (count,), generator=generator, device=generator.device)
        return self[index.to(self.distance.device)].to(device, dtype)

    def to(self, device: torch.device | str | None, dtype: torch.dtype) -> Observations:
        """Return a copy on another device and in another floating-point type."""
        origins, directions, rgb, distance = (
            part.to(device=device, dtype=dtype)
            for part in (self.origins, self.directions, self.rgb, self.distance)
        )
        return Observations(origins, directions, rgb, distance, self.coloured.to(device=device))

    def rays(self, T_world_ref: SE3, bounds: SceneBounds) -> Rays:
        """Return the rays in the world, clipped to the scene's bounds; differentiable with respect to the transform.

        A batch of transforms (h) gives rays of shape (h *p).
        """
        T = T_world_ref.to(self.origins)
        if T.translation.ndim > 1:
            ones = (1,) * self.distance.ndim
            batch = T.translation.shape[:-1]
            T = SE3(T.rotation.reshape(*batch, *ones, 3, 3), T.translation.reshape(*batch, *ones, 3))
        return bounds.rays(T.apply(self.origins), T.rotate(self.directions))

    def _tensors(self) -> tuple[Tensor, ...]:
        return self.origins, self.directions, self.rgb, self.distance, self.coloured
