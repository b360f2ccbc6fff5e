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
    Concentrated,
    FieldValues,
    Rays,
    RaySamples,
    RaySpacing,
    SceneBounds,
    VoxelGrid,
    rows_of,
)
from bidnerf_hashgrid import fused
from bidnerf_hashgrid.fused import MOST

BLOCK = 8
"""Steps along a ray that are skipped together if no occupied cell is near."""


class OccupancyGrid(nn.Module):
    """A cube of cells around the scene, and a ``RaySampler`` of equal steps within its occupied cells.

    A cell is occupied while some training ray has weight in it: matter that no ray sees, such as the inside of a solid, is
    not sampled. ``peak`` is the largest rendering weight observed in a cell; it decays with each step in which a ray visits
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
        self.register_load_state_dict_post_hook(lambda module, _: module._loaded())

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

        Without ``valid``, all samples count.
        """
        self.observed = True
        cells = self.grid.numbers(positions)
        for known, values in ((self.peak, weights), (self.density, density)):
            flat = known.view(-1)
            faded = flat.index_select(0, cells) * fade
            # A cell fades once per step, however many samples lie in it.
            if valid is None:
                flat.index_copy_(0, cells, faded)
            else:  # what does not count is no minimum and no maximum
                flat.scatter_reduce_(0, cells, torch.where(valid, faded, torch.inf), "amin")
                values = torch.where(valid, values, 0)
            flat.scatter_reduce_(0, cells, values.to(known), "amax")

    @torch.no_grad()
    def prune(self, threshold: float, grow: bool = True) -> None:
        """Recompute which cells are occupied: those whose peak is above ``threshold`` and, with ``grow``, their neighbours."""
        self.occupied.copy_(_dilated(self.peak > threshold, 1 if grow else 0))
        self._refresh()

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        """Return the intervals of the rays in occupied cells, equally long in the coordinate of ``SceneBounds.spacing``."""
        if not may_wait(rays.near.device):
            return self.of_known_shape(rays, self._most, jitter)
        march = self._march(rays, jitter)
        place, ray = self._occupied_steps(march)
        return self._padded(march, place, _counts(ray, march)).unflattened(rays.near.shape)

    @torch.no_grad()
    def split_by_count(
        self, rays: Rays, count: int, jitter: Generator | None = None
    ) -> tuple[RaySamples, Int[Tensor, "m"], RaySamples]:
        """Return the intervals that ``__call__`` returns, separately for rays with many of them, see
        ``SplittingSampler``.
        """
        march = self._march(rays, jitter)
        place, ray = self._occupied_steps(march)
        counts = _counts(ray, march)
        many = counts > count
        numbers, of_many = many.nonzero()[:, 0], many.index_select(0, ray)
        few = self._padded(march, place[~of_many], torch.where(many, 0, counts))
        rest = self._padded(march.rows(numbers), place[of_many], counts.index_select(0, numbers))
        return few.unflattened(rays.near.shape), numbers, rest

    def of_known_shape(self, rays: Rays, count: int, jitter: Generator | None) -> RaySamples:
        """Return the intervals in occupied cells or, on a GPU, at most ``count`` concentrated ones, without waiting.

        Only the first ``MOST`` of a ray count, except in training, when cells that are empty are still occupied.
        """
        if fused.available(rays.near.device) and count <= MOST:
            return fused.sampled(
                _flat(rays), self.bounds, self.occupied, self.density, self.step, count, self._most, jitter
            ).unflattened(rays.near.shape)
        return self._of_known_shape(self._march(rays, jitter)).unflattened(rays.near.shape)

    @property
    def _steps(self) -> int:
        """The largest number of steps along a ray in the grid.

        They fit into a cube's diagonal; before contracted space, a camera may be as far away again.
        """
        sides = 4 if self.bounds.contracted else math.sqrt(3)
        return math.ceil(sides * self.bounds.side / self.step) + 1

    @property
    def _most(self) -> int:
        return self._steps if self.training else MOST

    def _march(self, rays: Rays, jitter: Generator | None) -> _March:
        flat = _flat(rays)
        spacing = self.bounds.spacing(flat)
        near, far = spacing.place(torch.stack([flat.near, flat.far], dim=-1)).unbind(-1)
        offset = torch.full_like(near, 0.5)
        if jitter is not None:
            offset = torch.rand(near.shape, generator=jitter, device=jitter.device).to(near)
        return _March(flat, spacing, near, far, offset)

    def _occupied_steps(self, march: _March) -> tuple[Float[Tensor, "n"], Int[Tensor, "n"]]:
        """Return the coordinates of all steps in occupied cells, and the numbers of their rays in ascending order."""
        ray, start = self._busy_blocks(march)
        steps = torch.arange(BLOCK, dtype=start.dtype, device=start.device) * self.step
        far, offset = (part.index_select(0, ray) for part in (march.far, march.offset))
        place = start[:, None] + steps + (offset * self.step)[:, None]
        positions = _at(march.rays, march.spacing.rows(ray).distance(place), ray)
        block, step = (self._occupied_at(positions) & (place < far[:, None])).nonzero(as_tuple=True)
        return place.view(-1).index_select(0, block * BLOCK + step), ray.index_select(0, block)

    def _of_known_shape(self, march: _March) -> RaySamples:
        """Return the first intervals of each ray in occupied cells, without waiting for the device."""
        near, far = march.near, march.far
        box = self.grid.rays(march.rays.origins, march.rays.directions)
        # Steps are counted from ``near``, as everywhere, and those before the grid are skipped; contracted space has none.
        skipped = ((box.near - near) / self.step).floor().clamp(min=0) * (not self.bounds.contracted)
        steps, most = torch.arange(self._steps, dtype=near.dtype, device=near.device), self._most
        place = near[:, None] + (skipped[:, None] + steps + march.offset[:, None]) * self.step
        positions = march.rays.at(march.spacing.distance(place))
        kept = self._occupied_at(positions) & (place < far[:, None])
        order = (~kept).sort(dim=-1, stable=True).indices[:, :most]
        place, kept = place.gather(-1, order), kept.gather(-1, order)
        middles = torch.where(kept, place, far[:, None])
        if middles.shape[-1] < most:
            missing = most - middles.shape[-1]
            middles = torch.cat([middles, far[:, None].expand(-1, missing)], dim=-1)
            kept = pad(kept, (0, missing))
        return self._intervals(march, middles, kept, kept.sum(-1))

    def _occupied_at(self, positions: Float[Tensor, "*p 3"]) -> Bool[Tensor, "*p"]:
        """Return whether positions (metres, world) are within the grid, in an occupied cell."""
        grid = self.grid
        if grid.contracted is not None:  # contract once, not in each look-up
            positions = grid.contracted.normalized(positions)
            grid = replace(grid, contracted=None)
        return grid.at(self.occupied, positions) & grid.contains(positions)

    def _busy_blocks(self, march: _March) -> tuple[Tensor, Tensor]:
        """Return the ray and the start of each block of ``BLOCK`` steps that passes near an occupied cell, in order."""
        near, far = march.near, march.far
        length = BLOCK * self.step
        count = int(((far - near).amax() / length).ceil()) if near.numel() else 0
        starts = near[:, None] + length * torch.arange(count, dtype=near.dtype, device=near.device)
        positions = _at(march.rays, march.spacing.distance(starts + length / 2))
        near_matter = self.grid.at(self.near_occupied, positions)
        ray, block = ((starts < far[:, None]) & near_matter).nonzero(as_tuple=True)
        return ray, starts.view(-1).index_select(0, ray * count + block)

    def _padded(self, march: _March, place: Float[Tensor, "n"], counts: Int[Tensor, "r"]) -> RaySamples:
        """Return the samples, packed at the front of their ray's row; rows are padded to the length of the longest."""
        width = int(counts.amax()) if len(counts) else 0
        valid = torch.arange(width, device=counts.device) < counts[:, None]
        middles = march.far[:, None].expand(-1, width).masked_scatter(valid, place)
        return self._intervals(march, middles, valid, counts)

    def _intervals(
        self, march: _March, middles: Float[Tensor, "r s"], valid: Bool[Tensor, "r s"], counts: Int[Tensor, "r"]
    ) -> RaySamples:  # fmt: skip
        """Return intervals one step long around ``middles``, clipped to the rays; the first ``counts`` are valid."""
        near, far = march.near[:, None], march.far[:, None]
        half = self.step / 2
        starts = torch.where(valid, torch.maximum(middles - half, near), middles)
        ends = torch.where(valid, torch.minimum(middles + half, far), middles)
        if self.bounds.contracted:
            # The remainder of a step at the far end is short in the coordinate, but long in metres.
            last = torch.arange(middles.shape[-1], device=middles.device) == counts[:, None] - 1
            ends = torch.where(last & (far - ends < self.step), far, ends)
        return RaySamples(march.spacing.distance(starts), march.spacing.distance(ends), valid)

    def _loaded(self) -> None:
        self.observed = self.bounds.contracted or bool(self.density.any())
        self._refresh()

    def _refresh(self) -> None:
        self.near_occupied.copy_(_dilated(self.occupied, self._reach))


@dataclass(frozen=True, eq=False)
class _March:
    """Rays, and where steps along them begin and end."""

    rays: Rays
    spacing: RaySpacing
    near: Float[Tensor, "r"]  # in the coordinate of ``spacing``, unlike those of ``rays``
    far: Float[Tensor, "r"]
    offset: Float[Tensor, "r"]  # of the middle of the first step from ``near``, in steps

    def rows(self, numbers: Int[Tensor, "m"]) -> _March:
        """Return the march along the rays with these numbers."""
        near, far, offset = (part.index_select(0, numbers) for part in (self.near, self.far, self.offset))
        return _March(rows_of(self.rays, numbers), self.spacing.rows(numbers), near, far, offset)


def _flat(rays: Rays) -> Rays:
    leading = rays.near.dim()
    parts = (rays.origins, rays.directions, rays.near, rays.far)
    return Rays(*(part.detach().reshape(-1, *part.shape[leading:]) for part in parts))


def _counts(ray: Int[Tensor, "n"], march: _March) -> Int[Tensor, "r"]:
    return torch.bincount(ray, minlength=len(march.near))


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

    def _of_known_shape(self, rays: Rays, jitter: Generator | None) -> RaySamples:
        if fused.available(rays.near.device) and self.count <= MOST:
            return self.guide.grid.of_known_shape(rays, self.count, jitter)
        return super()._of_known_shape(rays, jitter)


def _at(
    rays: Rays, distance: Float[Tensor, "b s"], ray: Int[Tensor, "b"] | None = None
) -> Float[Tensor, "b s 3"]:
    """Return the positions at distances along the rays, or along those with the given numbers.

    In memory, the positions along an axis are contiguous: sums over rows of three numbers take ten times as long.
    """
    origins, directions = (part.t().contiguous() for part in (rays.origins, rays.directions))
    if ray is not None:
        origins, directions = origins.index_select(1, ray), directions.index_select(1, ray)
    return (origins[..., None] + distance * directions[..., None]).movedim(0, -1)


def _dilated(cells: Bool[Tensor, "n n n"], reach: int) -> Bool[Tensor, "n n n"]:
    """Return the cells within a cube of ``reach`` cells around any of ``cells``; the cube is the product of three lines."""
    grown = cells.clone()
    for axis in range(3):
        for _ in range(reach):
            line = grown.clone()
            count = cells.shape[axis] - 1
            grown.narrow(axis, 1, count).logical_or_(line.narrow(axis, 0, count))
            grown.narrow(axis, 0, count).logical_or_(line.narrow(axis, 1, count))
    return grown
