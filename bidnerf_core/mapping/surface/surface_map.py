"""The baked surface: surfels (small discs fused from points) with an index for nearest-neighbour look-up, and rays traced to it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.devices import Resident, TensorRows, constant, may_wait, move_to, working_device
from bidnerf_core.fields import VoxelGrid
from bidnerf_core.geometry import scale_point
from bidnerf_core.mapping.surface.surfel_index import SurfelIndex, index_bytes


@dataclass(frozen=True, eq=False)
class Surfels(TensorRows):
    """Points of a surface with normals and colours. World frame, metres."""

    positions: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # unit; their sign has no meaning
    rgb: Float[Tensor, "n 3"]
    rgb_gradient: Float[Tensor, "n 3 3"]  # channel by axis, per metre, within the plane


SURFEL_BYTES = 72
"""Memory (bytes) of a surfel: 18 numbers of 4 bytes each."""


def merge_cells(cells: Int[Tensor, "p"], *values: Float[Tensor, "p _"]) -> tuple[Int[Tensor, "n"], list[Tensor]]:
    """Return the occupied cells, in ascending order, and the means of the points' ``values`` in each."""
    occupied, index, counts = cells.unique(return_inverse=True, return_counts=True)
    means = [
        torch.zeros((len(occupied), v.shape[-1]), dtype=v.dtype).index_add_(0, index, v) / counts[:, None]
        for v in values
    ]
    return occupied, means


def fuse_surfels(positions: Float[Tensor, "n 3"], rgb: Float[Tensor, "n 3"]) -> Surfels:
    """Make surfels of merged points: fit a plane to the neighbours of each point and project it onto that plane."""
    points = positions.numpy()
    # One of the twelve is the point itself.
    _, index = cKDTree(points).query(points, k=min(12, len(points)), workers=-1)
    near = torch.from_numpy(np.asarray(index, dtype=np.int64).reshape(len(points), -1))
    offsets = positions[near] - positions[:, None]
    mean = offsets.mean(1)
    centred = offsets - mean[:, None]
    _, axes = torch.linalg.eigh(centred.mT @ centred)
    normals = axes[..., 0]
    positions = positions + normals * (normals * mean).sum(-1, keepdim=True)
    # The gradient of colour within the plane by least squares (Park et al. 2017, "Colored point cloud registration", eq. 10)
    flat = centred - (centred * normals[:, None]).sum(-1, keepdim=True) * normals[:, None]
    spread = flat.mT @ flat
    size = spread.diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=torch.finfo(flat.dtype).tiny)
    # Any weight along the normal makes the gradient 0 there; a little weight everywhere regularizes thin strips.
    regularization = normals[:, :, None] * normals[:, None] + 0.02 * torch.eye(3)
    colours, colour = rgb[near], rgb[near].mean(1)
    seen = flat.mT @ (colours - colour[:, None]) / size[:, None, None]
    gradient = torch.linalg.solve(spread / size[:, None, None] + regularization, seen).mT
    return Surfels(positions, normals, colour, gradient)


@dataclass(frozen=True, eq=False)
class SurfaceMap(Resident):
    """Surfels with an index for nearest-neighbour look-up in constant time."""

    surfels: Surfels
    index: SurfelIndex
    keyframes: Float[Tensor, "k 4 4"]  # T_world_camera of the images from which the surface was baked

    @property
    def device(self) -> torch.device:
        """Device of the surfels, their index and the keyframes, where rays and query points must be as well."""
        return self.surfels.positions.device

    def scaled(self, factor: float) -> SurfaceMap:
        """Return the surface with lengths multiplied by ``factor``; the entries of its index are unchanged."""
        parts, grid, keyframes = self.surfels, self.grid, self.keyframes.clone()
        keyframes[:, :3, 3] *= factor
        surfels = replace(parts, positions=parts.positions * factor, rgb_gradient=parts.rgb_gradient / factor)
        moved_grid = VoxelGrid(scale_point(grid.lower, factor), grid.cell * factor, grid.shape)
        return replace(self, surfels=surfels, index=replace(self.index, grid=moved_grid), keyframes=keyframes)

    def to(self, device: torch.device | str) -> SurfaceMap:
        """Return the surface on another device; ``self`` if it is already there."""
        return move_to(self, working_device(device))

    @property
    def grid(self) -> VoxelGrid:
        """The voxel grid in which points are looked up."""
        return self.index.grid

    @property
    def mebibytes(self) -> float:
        """Memory of the surfels and their index, in MiB."""
        return (SURFEL_BYTES * len(self.surfels) + index_bytes(self.index.level)) / 2**20

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
    def surfel_radius(self) -> float:
        """Distance from a surfel within which a ray counts as hitting it (metres).

        It is 0.7 times the 90th percentile of the surfels' distances to their fourth neighbours: large enough to leave
        few holes between them, small enough to preserve edges.
        """
        points = self.surfels.positions.cpu().numpy()  # scipy's tree runs on the host
        neighbour = min(5, len(points))  # the point itself and its four neighbours
        away, _ = cKDTree(points).query(points[:: max(1, len(points) // 5000)], k=neighbour)
        return 0.7 * float(np.quantile(np.asarray(away).reshape(-1, neighbour)[:, -1], 0.9)) or self.cell

    @cached_property
    def box(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Corners (metres, world) of the box that contains the middle 90 % of the surfels along each axis."""
        ordered = self.surfels.positions.sort(0).values
        last = len(ordered) - 1
        return ordered[round(0.05 * last)], ordered[round(0.95 * last)]

    def warm_up(self) -> None:
        """Compute the cached extent and radius now, so that the first localization takes no longer than the others."""
        _ = self.extent, self.surfel_radius
        self.index.warm_up()

    def nearest(self, points: Float[Tensor, "*p 3"]) -> Int[Tensor, "*p"]:
        """Return the index of the surfel nearest to each point (metres, world), to the accuracy of ``SurfelIndex``.

        A point outside the grid is first clamped to the grid's border.
        """
        return self.index(points)

    def distance(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p"]:
        """Return the distance from each point to its nearest surfel (metres)."""
        return torch.linalg.vector_norm(points - self.surfels.positions[self.nearest(points)], dim=-1)


@dataclass(frozen=True, eq=False)
class Cast:
    """The point at which each ray hit the surface or, if the ray missed, came closest to the surface in angle."""

    met: Bool[Tensor, "r"]
    along: Float[Tensor, "r"]  # metres along the ray to that point
    index: Int[Tensor, "r"]  # the surfel nearest to it


def cast(
    surface: SurfaceMap,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    steps: int = 36,
    radius: float | None = None,
) -> Cast:
    """Trace rays (metres, world; unit directions) until they come within ``radius`` of a surfel.

    The radius is in metres, by default that of the surfels. A step is as long as the clearance, but at least a cell.

    For a ray that misses the grid, the closest point is that nearest to the grid's centre. Rays must be on the surface's
    device. Where the host must not wait for the device, finished rays keep being traced, without effect.
    """
    radius = surface.surfel_radius if radius is None else radius
    rays, cell = surface.grid.rays(origins, directions), surface.grid.cell
    best = ((constant(surface.grid.centre, origins) - origins) * directions).sum(-1).clamp(min=0)
    index = surface.nearest(rays.at(best[:, None])[:, 0])
    least, met = torch.full_like(best, torch.inf), torch.zeros_like(best, dtype=torch.bool)
    left, on = torch.arange(len(best), device=best.device), rays.near < rays.far
    here, o, d, far = rays.near, origins, directions, rays.far
    for step in range(steps):
        # Rays that have hit the surface or left the grid are dropped every six steps.
        if step % 6 == 0 and may_wait(best.device):
            left, here, o, d, far = left[on], here[on], o[on], d[on], far[on]
            on = torch.ones_like(left, dtype=torch.bool)
            if not len(left):
                break
        points = o + here[:, None] * d
        nearest = surface.nearest(points)
        clearance = torch.linalg.vector_norm(points - surface.surfels.positions[nearest], dim=-1)
        hit = clearance < radius
        angle = torch.where(hit, 0, clearance / here.clamp(min=cell))
        closer = on & (angle < least[left])
        for values, new in ((least, angle), (best, here), (index, nearest)):
            values[left] = torch.where(closer, new, values[left])
        met[left] |= on & hit
        here = torch.where(hit, here, here + clearance.clamp(min=cell))
        if step % 6 == 5:
            on = on & (here < far) & ~hit
    return Cast(met, best, index)


def trace(
    surface: SurfaceMap, origins: Float[Tensor, "*r 3"], directions: Float[Tensor, "*r 3"], steps: int = 48
) -> Float[Tensor, "*r"]:
    """Return the distance (metres) at which each ray comes within one cell size of the surface inside the grid.

    It is infinite if the ray never does. ``directions`` are unit vectors.
    """
    shape, (origins, directions) = directions.shape[:-1], (x.reshape(-1, 3) for x in (origins, directions))
    hits = cast(surface, origins, directions, steps, surface.grid.cell)
    within = hits.met & (hits.along < surface.grid.rays(origins, directions).far)
    return torch.where(within, hits.along, torch.inf).reshape(shape)
