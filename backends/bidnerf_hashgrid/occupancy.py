"""The occupancy grid, which records where a field has visible matter and samples only there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn
from torch.nn.functional import pad

from bidnerf_core.devices import may_wait
from bidnerf_core.fields import (
    FieldValues,
    Rays,
    RaySamples,
    RaySpacing,
    SceneBounds,
    VoxelGrid,
)
from bidnerf_hashgrid import fused
from bidnerf_hashgrid.concentration import Concentrated
from bidnerf_hashgrid.fused import MOST

BLOCK = 8
"""Steps along a ray that are skipped together if no occupied cell is near."""


class OccupancyGrid(nn.Module):
    """A cube of cells around the scene, and a ``RaySampler`` of equal steps within its occupied cells.

    A cell is occupied while some training ray has rendering weight in it; matter that no ray sees, such as the inside of a
    solid, is not sampled. ``peak`` is the largest rendering weight observed in a cell; it decays with each step in which a ray visits
    the cell and otherwise stays the same. Occupied cells are those whose peak is above a threshold and, while surfaces may
    still move, their neighbours.
    """

    peak: Float[Tensor, "n n n"]
    density: Float[Tensor, "n n n"]  # per metre: the largest observed recently in each cell
    samples_per_ray: Float[Tensor, ""]  # running mean over training rays
    occupied: Bool[Tensor, "n n n"]
    near_occupied: Bool[Tensor, "n n n"]

    def __init__(self, bounds: SceneBounds, resolution: int, steps_per_cell: int = 2) -> None:
        super().__init__()
        self.bounds = bounds
        self.grid = VoxelGrid.cube(bounds, resolution)
        # Metres in the uncontracted cube, which is half as wide as a contracted grid.
        self.step = bounds.side * (2 if bounds.contracted else 1) / (resolution * steps_per_cell)
        self._reach = -(-BLOCK // (2 * steps_per_cell))  # cells from the middle of a block to its ends
        shape = self.grid.shape
        self.register_buffer("peak", torch.ones(shape))
        self.register_buffer("density", torch.zeros(shape))
        self.register_buffer("samples_per_ray", torch.full((), float(resolution)))
        self.register_buffer("occupied", torch.ones(shape, dtype=torch.bool))
        self.register_buffer("near_occupied", torch.ones(shape, dtype=torch.bool), persistent=False)
        # A contracted scene is too large for equal steps, even at the beginning.
        self.observed = bounds.contracted
        self.register_load_state_dict_post_hook(lambda module, _: module._on_load())

    @torch.no_grad()
    def restrict(self, allowed: Bool[Tensor, "n n n"]) -> None:
        """Mark all cells but ``allowed`` as empty."""
        self.peak *= allowed.to(self.peak.device)
        self.prune(0.0)

    @torch.no_grad()
    def observe(
        self,
        positions: Float[Tensor, "p 3"],
        weights: Float[Tensor, "p"],
        density: Float[Tensor, "p"],
        fade: float,
        valid: Bool[Tensor, "p"] | None = None,
    ) -> None:
        """Update peaks and densities with the rendering weights and densities of a batch at ``positions`` (metres, world).

        In each visited cell, the old values are first multiplied by ``fade``. Without ``valid``, all samples count.
        """
        self.observed = True
        cells = self.grid.numbers(positions)
        for known, values in ((self.peak, weights), (self.density, density)):
            flat = known.view(-1)
            faded = flat.index_select(0, cells) * fade
            # A cell fades once per step, however many samples lie in it.
            if valid is None:
                flat.index_copy_(0, cells, faded)
            else:  # invalid samples must change neither the minimum nor the maximum
                flat.scatter_reduce_(0, cells, torch.where(valid, faded, torch.inf), "amin")
                values = torch.where(valid, values, 0)
            flat.scatter_reduce_(0, cells, values.to(known), "amax")

    @torch.no_grad()
    def prune(self, threshold: float, grow: bool = True) -> None:
        """Recompute which cells are occupied: those whose peak is above ``threshold`` and, with ``grow``, their neighbours."""
        self.occupied.copy_(_dilate(self.peak > threshold, 1 if grow else 0))
        self.near_occupied.copy_(_dilate(self.occupied, self._reach))

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        """Return the intervals of the rays in occupied cells, equally long in the coordinate of ``SceneBounds.spacing``.

        If the host must not wait, only the first ``MOST`` intervals of a ray are kept, except in training, when empty cells are
        still marked as occupied.
        """
        if (samples := self.by_kernel(rays, self._most, jitter)) is not None:
            return samples
        flat = rays.flattened()
        spacing = self.bounds.spacing(flat)
        near, far = spacing.coordinate(torch.stack([flat.near, flat.far], dim=-1)).unbind(-1)
        offset = torch.full_like(near, 0.5)  # of the middle of the first step from ``near``, in steps
        if jitter is not None:
            offset = torch.rand(near.shape, generator=jitter, device=jitter.device).to(near)
        find = self._all_steps if may_wait(near.device) else self._first_steps
        middles, valid = find(flat, spacing, near, far, offset)
        near, far, half = near[:, None], far[:, None], self.step / 2
        starts = torch.where(valid, torch.maximum(middles - half, near), middles)
        ends = torch.where(valid, torch.minimum(middles + half, far), middles)
        if self.bounds.contracted:
            # The remainder of a step at the far end is short in the coordinate, but long in metres.
            last = torch.arange(middles.shape[-1], device=middles.device) == valid.sum(-1, keepdim=True) - 1
            ends = torch.where(last & (far - ends < self.step), far, ends)
        return RaySamples(spacing.distance(starts), spacing.distance(ends), valid).unflattened(rays.near.shape)

    def by_kernel(self, rays: Rays, count: int, jitter: Generator | None) -> RaySamples | None:
        """Return up to ``count`` intervals per ray in occupied cells, concentrated if there are more; None if no kernel is used."""
        device = rays.near.device
        if may_wait(device) or not fused.available(device) or count > MOST:
            return None
        return fused.sample(
            rays.flattened(), self.bounds, self.occupied, self.density, self.step, count, self._most, jitter
        ).unflattened(rays.near.shape)

    @property
    def _steps(self) -> int:
        """The largest number of steps along a ray in the grid.

        The steps cover the cube's diagonal; in front of contracted space, a camera may be that far away again.
        """
        sides = 4 if self.bounds.contracted else math.sqrt(3)
        return math.ceil(sides * self.bounds.side / self.step) + 1

    @property
    def _most(self) -> int:
        return self._steps if self.training else MOST

    def _all_steps(
        self,
        rays: Rays,
        spacing: RaySpacing,
        near: Float[Tensor, "r"],
        far: Float[Tensor, "r"],
        offset: Float[Tensor, "r"],
    ) -> tuple[Float[Tensor, "r s"], Bool[Tensor, "r s"]]:
        """Return the coordinates of each ray's steps in occupied cells, padded to the longest row, and the mask of real steps."""
        length = BLOCK * self.step
        count = int(((far - near).amax() / length).ceil()) if near.numel() else 0
        starts = near[:, None] + length * torch.arange(count, dtype=near.dtype, device=near.device)
        near_matter = self.grid.at(self.near_occupied, _at(rays, spacing.distance(starts + length / 2)))
        ray, block = ((starts < far[:, None]) & near_matter).nonzero(as_tuple=True)
        start = starts.view(-1).index_select(0, ray * count + block)
        steps = torch.arange(BLOCK, dtype=near.dtype, device=near.device) * self.step
        coordinate = start[:, None] + steps + (offset.index_select(0, ray) * self.step)[:, None]
        positions = _at(rays, RaySpacing(spacing.exit.index_select(0, ray), spacing.radius).distance(coordinate), ray)
        occupied = self._occupied_at(positions) & (coordinate < far.index_select(0, ray)[:, None])
        block, step = occupied.nonzero(as_tuple=True)
        coordinate = coordinate.view(-1).index_select(0, block * BLOCK + step)
        counts = torch.bincount(ray.index_select(0, block), minlength=len(near))
        width = int(counts.amax()) if len(counts) else 0
        valid = torch.arange(width, device=counts.device) < counts[:, None]
        return far[:, None].expand(-1, width).masked_scatter(valid, coordinate), valid

    def _first_steps(
        self,
        rays: Rays,
        spacing: RaySpacing,
        near: Float[Tensor, "r"],
        far: Float[Tensor, "r"],
        offset: Float[Tensor, "r"],
    ) -> tuple[Float[Tensor, "r s"], Bool[Tensor, "r s"]]:
        """Return each ray's first steps in occupied cells in the form of ``_all_steps``, without waiting for the device."""
        box = self.grid.rays(rays.origins, rays.directions)
        # Steps are counted from ``near``, as everywhere. Those before the grid are skipped; a contracted grid has none.
        skipped = ((box.near - near) / self.step).floor().clamp(min=0) * (not self.bounds.contracted)
        steps, most = torch.arange(self._steps, dtype=near.dtype, device=near.device), self._most
        coordinate = near[:, None] + (skipped[:, None] + steps + offset[:, None]) * self.step
        occupied = self._occupied_at(rays.at(spacing.distance(coordinate))) & (coordinate < far[:, None])
        order = (~occupied).sort(dim=-1, stable=True).indices[:, :most]
        coordinate, occupied = coordinate.gather(-1, order), occupied.gather(-1, order)
        missing = most - occupied.shape[-1]
        middles = torch.cat([torch.where(occupied, coordinate, far[:, None]), far[:, None].expand(-1, missing)], dim=-1)
        return middles, pad(occupied, (0, missing))

    def _occupied_at(self, positions: Float[Tensor, "*p 3"]) -> Bool[Tensor, "*p"]:
        """Return whether positions (metres, world) lie in an occupied cell of the grid."""
        grid = self.grid
        if grid.contracted is not None:  # contract once, not in each look-up
            positions = grid.contracted.normalized(positions)
            grid = replace(grid, contracted=None)
        return grid.at(self.occupied, positions) & grid.contains(positions)

    def _on_load(self) -> None:
        self.observed = self.bounds.contracted or bool(self.density.any())
        self.near_occupied.copy_(_dilate(self.occupied, self._reach))


@dataclass(frozen=True)
class GridDensity:
    """The densities that an occupancy grid has observed, as a coarse field without colours."""

    grid: OccupancyGrid

    @property
    def sampler(self) -> OccupancyGrid:
        return self.grid

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        density = self.grid.grid.at(self.grid.density, positions)
        return FieldValues(density, torch.zeros_like(positions))


@dataclass(frozen=True)
class ConcentratedInGrid(Concentrated):
    """Intervals concentrated by the densities that a grid has observed."""

    guide: GridDensity

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        samples = self.guide.grid.by_kernel(rays, self.count, jitter)
        return super().__call__(rays, jitter) if samples is None else samples


def _at(rays: Rays, distance: Float[Tensor, "b s"], ray: Int[Tensor, "b"] | None = None) -> Float[Tensor, "b s 3"]:
    """Return the positions at distances along the rays, or along the rays with the indices ``ray``.

    Each coordinate of the positions is contiguous in memory, since sums over rows of three numbers take ten times as long.
    """
    origins, directions = (part.t().contiguous() for part in (rays.origins, rays.directions))
    if ray is not None:
        origins, directions = origins.index_select(1, ray), directions.index_select(1, ray)
    return (origins[..., None] + distance * directions[..., None]).movedim(0, -1)


def _dilate(cells: Bool[Tensor, "n n n"], reach: int) -> Bool[Tensor, "n n n"]:
    """Return the cells at most ``reach`` cells away from any of ``cells`` along each axis; the cube is dilated one axis at a time."""
    grown = cells.clone()
    for axis in range(3):
        for _ in range(reach):
            line = grown.clone()
            count = cells.shape[axis] - 1
            grown.narrow(axis, 1, count).logical_or_(line.narrow(axis, 0, count))
            grown.narrow(axis, 0, count).logical_or_(line.narrow(axis, 1, count))
    return grown
