"""The baked surface: which surfel is nearest, known for every cell of a grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.field import SceneBounds
from bidnerf_core.mapping.surfels import Surfels

REACH = 0.7
"""Of the distance to the fourth neighbour of a surfel, how much is its own."""


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Surfels and a grid of cells about them, each of which knows its nearest surfel."""

    surfels: Surfels
    lower: tuple[float, float, float]  # metres, world: corner of the grid
    cell: float  # metres: side of a cell
    nearest: Int[Tensor, "x y z"]  # index of a surfel, int32
    keyframes: Float[Tensor, "k 4 4"]  # T_world_camera from which the surface was seen

    @cached_property
    def extent(self) -> float:
        """Metres: diagonal of the box that holds nine tenths of the surfels along each axis."""
        low, high = self.box
        return float(torch.linalg.vector_norm(high - low))

    @cached_property
    def reach(self) -> float:
        """Metres from a surfel at which a ray has met it, so that there are few holes between surfels and edges stay where
        they are: by how far away, for nine tenths of them, the fourth neighbour is.
        """
        points = self.surfels.positions.numpy()
        away, _ = cKDTree(points).query(points[:: max(1, len(points) // 5000)], k=min(5, len(points)))
        return (
            REACH * float(np.quantile(np.asarray(away).reshape(-1, min(5, len(points)))[:, -1], 0.9))
            or self.cell
        )

    @cached_property
    def box(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Corners of the box that holds nine tenths of the surfels along each axis: stray ones make it no larger."""
        ordered = self.surfels.positions.sort(0).values
        last = len(ordered) - 1
        return ordered[round(0.05 * last)], ordered[round(0.95 * last)]

    def warm_up(self) -> None:
        """Compute now what is derived from the surfels once and cached: the extent and the reach."""
        _ = self.extent, self.reach

    def touch(self, points: Float[Tensor, "*p 3"]) -> Int[Tensor, "*p"]:
        """Index of the surfel nearest to each point; beyond the grid, what is nearest to its border counts."""
        return self.nearest.view(-1)[self._cells(points)].long()

    def distance(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p"]:
        """Metres from the nearest surfel."""
        return torch.linalg.vector_norm(points - self.surfels.positions[self.touch(points)], dim=-1)

    def trace(
        self, origins: Float[Tensor, "*r 3"], directions: Float[Tensor, "*r 3"], steps: int = 48
    ) -> Float[Tensor, "*r"]:
        """Distance (metres) at which each half-line first meets the surface within the grid, infinite where it does not
        (sphere tracing, Hart 1996). ``directions`` are unit.
        """
        x, y, z = (low + size * self.cell for low, size in zip(self.lower, self.nearest.shape, strict=True))
        rays = SceneBounds(self.lower, (x, y, z), 0.0, 1e9).rays(origins, directions)
        along, met = rays.near.clone(), torch.zeros_like(rays.near, dtype=torch.bool)
        for _ in range(steps):
            clear = self.distance(rays.at(along[..., None])[..., 0, :])
            met = met | ((clear < self.cell) & (along < rays.far))
            along = torch.where(met, along, along + clear.clamp(min=self.cell))
        return torch.where(met, along, torch.inf)

    def _cells(self, points: Float[Tensor, "*p 3"]) -> Int[Tensor, "*p"]:
        shape = self.nearest.shape
        scaled = (points - points.new_tensor(self.lower)) * (1 / self.cell)
        x, y, z = (scaled[..., axis].clamp(0, size - 1).long() for axis, size in enumerate(shape))
        return (x * shape[1] + y) * shape[2] + z


def nearest_surfels(occupied: Int[Tensor, "n"], shape: tuple[int, int, int]) -> Int[Tensor, "x y z"]:
    """Index into ``occupied`` (numbers of cells, one surfel each) of the one nearest to each cell of the grid."""
    if not len(occupied):
        raise InputError("no surface to bake: no point that several views agree on")
    empty = torch.ones(shape, dtype=torch.bool)
    empty.view(-1)[occupied] = False
    place = torch.from_numpy(
        distance_transform_edt(empty.numpy(), return_distances=False, return_indices=True)
    ).long()
    number = torch.full(shape, -1, dtype=torch.int32)
    number.view(-1)[occupied] = torch.arange(len(occupied), dtype=torch.int32)
    return number[place[0], place[1], place[2]]
