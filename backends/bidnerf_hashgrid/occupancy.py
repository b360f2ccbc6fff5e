"""The occupancy grid, which records where a field has visible matter and samples only there."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn
from torch.nn.functional import pad

from bidnerf_core.contraction import RaySpacing
from bidnerf_core.field import FieldValues, Rays, RaySamples, SceneBounds
from bidnerf_core.voxel_grid import VoxelGrid
from bidnerf_core.waiting import may_wait

BLOCK = 8
"""Steps along a ray that are skipped together where no occupied cell is near."""

MOST = 96
"""Maximum number of samples per ray where the host must not wait to count them; the nearest ones in occupied cells are kept."""


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
    ) -> None:
        """Update peaks and densities with the rendering weights and densities of a batch at ``positions`` (metres, world)."""
        self.observed = True
        cells = self.grid.numbers(positions)
        for known, values in ((self.peak, weights), (self.density, density)):
            flat = known.view(-1)
            flat.index_copy_(
                0, cells, flat.index_select(0, cells) * fade
            )  # once per step, however many samples lie in the cell
            flat.scatter_reduce_(0, cells, values.to(known), "amax")

    @torch.no_grad()
    def prune(self, threshold: float, grow: bool = True) -> None:
        """Recompute which cells are occupied: those whose peak is above ``threshold`` and, with ``grow``, their neighbours."""
        self.occupied.copy_(_dilated(self.peak > threshold, 1 if grow else 0))
        self._refresh()

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        """Return the intervals of the rays in occupied cells, equally long in the coordinate of ``SceneBounds.spacing``."""
        shape = rays.near.shape
        flat = Rays(*(part.detach().reshape(-1, *part.shape[len(shape) :]) for part in
                      (rays.origins, rays.directions, rays.near, rays.far)))  # fmt: skip
        spacing = self.bounds.spacing(flat)
        limits = spacing.place(torch.stack([flat.near, flat.far], dim=-1))
        near, far = limits.unbind(-1)
        offset = torch.full_like(near, 0.5)
        if jitter is not None:
            offset = torch.rand(near.shape, generator=jitter, device=jitter.device).to(near)
        if not may_wait(near.device):
            samples = self._of_known_shape(flat, spacing, near, far, offset)
            starts, ends = (spacing.distance(x).reshape(*shape, MOST) for x in (samples.starts, samples.ends))
            return RaySamples(starts, ends, samples.valid.reshape(*shape, MOST))
        ray, start = self._busy_blocks(flat, spacing, near, far)
        steps = torch.arange(BLOCK, dtype=near.dtype, device=near.device) * self.step
        offsets, exits, ends = (part.index_select(0, ray) for part in (offset, spacing.exit, far))
        place = start[:, None] + steps + (offsets * self.step)[:, None]
        positions = _at(flat, RaySpacing(exits, spacing.radius).distance(place), ray)
        block, step = (self._occupied_at(positions) & (place < ends[:, None])).nonzero(as_tuple=True)
        kept = place.view(-1).index_select(0, block * BLOCK + step)
        samples = self._padded(kept, ray.index_select(0, block), near, far)
        width = samples.valid.shape[-1]
        starts, ends = (
            spacing.distance(part).reshape(*shape, width) for part in (samples.starts, samples.ends)
        )
        return RaySamples(starts, ends, samples.valid.reshape(*shape, width))

    def _of_known_shape(
        self, rays: Rays, spacing: RaySpacing, near: Tensor, far: Tensor, offset: Tensor
    ) -> RaySamples:
        """Return the first ``MOST`` intervals of each ray in occupied cells, without waiting for the device."""
        box = self.grid.rays(rays.origins, rays.directions)
        # Steps are counted from ``near``, as everywhere, and those before the grid are skipped; contracted space has none.
        skipped = ((box.near - near) / self.step).floor().clamp(min=0) * (not self.bounds.contracted)
        count = math.ceil(2 * self.bounds.side / self.step) + 1  # a cube's diagonal is shorter
        steps = torch.arange(count, dtype=near.dtype, device=near.device)
        place = near[:, None] + (skipped[:, None] + steps + offset[:, None]) * self.step
        positions = rays.at(spacing.distance(place))
        kept = self._occupied_at(positions) & (place < far[:, None])
        order = (~kept).sort(dim=-1, stable=True).indices[:, :MOST]
        place, kept = place.gather(-1, order), kept.gather(-1, order)
        middles = torch.where(kept, place, far[:, None])
        if middles.shape[-1] < MOST:
            missing = MOST - middles.shape[-1]
            middles = torch.cat([middles, far[:, None].expand(-1, missing)], dim=-1)
            kept = pad(kept, (0, missing))
        return self._intervals(middles, kept, kept.sum(-1), near, far)

    def _occupied_at(self, positions: Float[Tensor, "*p 3"]) -> Bool[Tensor, "*p"]:
        """Return whether positions (metres, world) are within the grid, in an occupied cell."""
        grid = self.grid
        if grid.contracted is not None:  # contract once, not in each look-up
            positions = grid.contracted.normalized(positions)
            grid = replace(grid, contracted=None)
        return grid.at(self.occupied, positions) & grid.contains(positions)

    def _busy_blocks(
        self, rays: Rays, spacing: RaySpacing, near: Tensor, far: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the ray and the start of each block of ``BLOCK`` steps that passes near an occupied cell, in order."""
        length = BLOCK * self.step
        count = int(((far - near).amax() / length).ceil()) if near.numel() else 0
        starts = near[:, None] + length * torch.arange(count, dtype=near.dtype, device=near.device)
        positions = _at(rays, spacing.distance(starts + length / 2))
        near_matter = self.grid.at(self.near_occupied, positions)
        ray, block = ((starts < far[:, None]) & near_matter).nonzero(as_tuple=True)
        return ray, starts.view(-1).index_select(0, ray * count + block)

    def _padded(self, place: Tensor, ray: Tensor, near: Tensor, far: Tensor) -> RaySamples:
        """Return the samples, packed at the front of their ray's row; rows are padded to the length of the longest."""
        counts = torch.bincount(ray, minlength=len(near))
        width = int(counts.amax()) if len(near) else 0
        valid = torch.arange(width, device=ray.device) < counts[:, None]
        middles = far[:, None].expand(-1, width).masked_scatter(valid, place)
        return self._intervals(middles, valid, counts, near, far)

    def _intervals(
        self, middles: Tensor, valid: Tensor, counts: Tensor, near: Tensor, far: Tensor
    ) -> RaySamples:
        """Return intervals one step long around ``middles`` (r s), clipped to the rays; the first ``counts`` (r) are valid."""
        number = torch.arange(middles.shape[-1], device=middles.device)
        half = self.step / 2
        starts = torch.where(valid, torch.maximum(middles - half, near[:, None]), middles)
        ends = torch.where(valid, torch.minimum(middles + half, far[:, None]), middles)
        if (
            self.bounds.contracted
        ):  # the remainder of a step at the far end is short in the coordinate, but long in metres
            rest = (number == counts[:, None] - 1) & (far[:, None] - ends < self.step)
            ends = torch.where(rest, far[:, None], ends)
        return RaySamples(starts, ends, valid)

    def _loaded(self) -> None:
        self.observed = self.bounds.contracted or bool(self.density.any())
        self._refresh()

    def _refresh(self) -> None:
        self.near_occupied.copy_(_dilated(self.occupied, self._reach))


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
