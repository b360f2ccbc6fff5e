"""The baked surface: surfels, and an index that finds the one nearest to a point."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.devices import moved, working_device
from bidnerf_core.fields.voxel_grid import VoxelGrid
from bidnerf_core.mapping.surface.surfel_index import SurfelIndex
from bidnerf_core.mapping.surface.surfels import Surfels, surfel_bytes

REACH = 0.7
"""Radius of a surfel, as a fraction of its distance from its fourth neighbour."""


@dataclass(frozen=True, eq=False)
class SurfaceMap:
    """Surfels, and the index that finds the one nearest to a point in constant time."""

    surfels: Surfels
    index: SurfelIndex
    keyframes: Float[Tensor, "k 4 4"]  # T_world_camera from which the surface was seen

    @property
    def device(self) -> torch.device:
        """Device of the surfels, their index and the keyframes, and of the rays and points that meet them."""
        return self.surfels.positions.device

    def to(self, device: torch.device | str) -> SurfaceMap:
        """Return the surface on another device; ``self`` if it is already there."""
        return moved(self, working_device(device))

    @property
    def grid(self) -> VoxelGrid:
        """The cells around the surface in which points are looked up."""
        return self.index.grid

    @property
    def bytes(self) -> int:
        """Memory that the surfels and their index take."""
        return surfel_bytes(len(self.surfels)) + self.index.bytes

    @property
    def mebibytes(self) -> float:
        """Memory that the surfels and their index take, in MiB."""
        return self.bytes / 2**20

    @property
    def stored_cells(self) -> int:
        """Number of entries of the index: one for each cell near the surface, and one for several cells far from it."""
        return len(self.index.entries)

    @property
    def cell(self) -> float:
        """Side of a cell of the grid (metres)."""
        return self.grid.cell

    @cached_property
    def extent(self) -> float:
        """Size of the scene (metres): the diagonal of ``box``."""
        low, high = self.box
        return float(torch.linalg.vector_norm(high - low))

    @cached_property
    def reach(self) -> float:
        """Distance from a surfel at which a ray counts as having met it (metres).

        It is a share of the distance to the fourth neighbour, which nine tenths of the surfels do not exceed: large enough
        to leave few holes between them, small enough to keep edges.
        """
        points = self.surfels.positions.cpu().numpy()  # scipy's tree is the host's
        away, _ = cKDTree(points).query(points[:: max(1, len(points) // 5000)], k=min(5, len(points)))
        return (
            REACH * float(np.quantile(np.asarray(away).reshape(-1, min(5, len(points)))[:, -1], 0.9))
            or self.cell
        )

    @cached_property
    def box(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Corners (metres, world) of the box that holds the middle nine tenths of the surfels along each axis."""
        ordered = self.surfels.positions.sort(0).values
        last = len(ordered) - 1
        return ordered[round(0.05 * last)], ordered[round(0.95 * last)]

    def warm_up(self) -> None:
        """Compute the cached extent and reach now, so that the first localization takes no longer than the others."""
        _ = self.extent, self.reach
        self.index.warm_up()

    def nearest(self, points: Float[Tensor, "*p 3"]) -> Int[Tensor, "*p"]:
        """Return the index of the surfel nearest to each point (metres, world), as exactly as ``SurfelIndex`` finds it.

        A point outside the grid is first clamped to the grid's border.
        """
        return self.index(points)

    def distance(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p"]:
        """Return the distance from each point to its nearest surfel (metres)."""
        return torch.linalg.vector_norm(points - self.surfels.positions[self.nearest(points)], dim=-1)
