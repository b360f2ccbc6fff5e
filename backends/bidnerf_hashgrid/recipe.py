"""Training of a hash-grid field: its settings and its recipe."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import adaptive_max_pool3d

from bidnerf_core.carving import occupied_voxels
from bidnerf_core.devices import may_wait
from bidnerf_core.errors import InputError
from bidnerf_core.fields import (
    FieldValues,
    RadianceField,
    Rays,
    RaySamples,
    SceneBounds,
    device_of,
    points_of,
    query_samples,
    render_values,
    rendering_weights,
)
from bidnerf_core.frames import View
from bidnerf_core.settings import Count, NotNegative, Positive, Range
from bidnerf_core.training import Replayable, Report, StepOutcome, Supervision, SupervisionConfig
from bidnerf_hashgrid.field import CoarseField, FieldConfig, HashGridField
from bidnerf_hashgrid.occupancy import OccupancyGrid
from bidnerf_hashgrid.threads import pools_only

log = logging.getLogger("bidnerf")

SETTLED = 10
"""Step up to which the number of samples per ray changes so much that it is read in each step."""
SPARE = 1.25
"""Room for a step's samples on a GPU, relative to their expected number: the standard deviation is a few per cent."""


@dataclass(frozen=True)
class HashGridConfig(FieldConfig, SupervisionConfig):
    """Size and training of the field. With the defaults, training takes a few minutes on a small CPU."""

    steps: Count = 6400  # steps of the optimizer
    # approximate number of samples per step, which sets the number of rays
    samples_per_step: Count = 16384
    # learning rate of the tables, half of it in contracted scenes; the networks have a quarter of it
    learning_rate: Positive = 2e-2
    # steps from one update of the coarse field to the next; 0: it is not trained
    coarse_every: Annotated[int, Range(0)] = 4
    seed: Annotated[int, Range(0), "N"] = 0  # seed of the initial weights and of all random draws
    rays_at_most: Count = 16384  # maximum number of rays per step
    prune_from: Annotated[int, Range(0)] = 200  # first step at which empty cells are skipped
    prune_every: Count = 16  # steps from one update of the occupied cells to the next
    prune_fade: Annotated[float, Range(0, 1)] = 0.95  # factor on a cell's weight when rays visit it
    prune_threshold: NotNegative = 0.01  # rendering weight up to which a cell is empty
    # fraction of the steps in which neighbours of occupied cells are sampled too
    grow_until: NotNegative = 0.6
    carve: bool = True  # begin with the cells that the views' depth and silhouettes do not show to be empty

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.coarse_every == 1:
            raise InputError("coarse_every is 1", expected="0 or 2 and more: the field itself would not be trained")
        if self.coarse_every > self.prune_every:
            raise InputError(
                f"coarse_every is {self.coarse_every}", expected=f"{self.prune_every} (prune_every) or less"
            )


def adapt(config: HashGridConfig, bounds: SceneBounds) -> HashGridConfig:
    """Return the config with slower pruning, and half the learning rate, if the scene is contracted.

    In a contracted scene, a ray crosses many cells, hardly any of which depth or silhouettes have shown to be empty, and a
    cell that is pruned too early is rarely found again. Training at the full rate was less stable: of
    twelve unseen photos of a phone capture, one lost 5 dB.
    """
    if not bounds.contracted:
        return config
    return replace(
        config,
        learning_rate=config.learning_rate / 2,
        prune_fade=config.prune_fade**0.4,
        prune_threshold=config.prune_threshold / 5,
        grow_until=max(config.grow_until, 0.9),
    )


def train(field: HashGridField, views: Sequence[View], config: HashGridConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``Supervision.fit`` for checkpoints and stopping."""
    if config.carve and report.resume() is None:
        allowed = occupied_voxels(views, field.occupancy.grid, device=device_of(field))
        field.occupancy.restrict(allowed)
        coarse = adaptive_max_pool3d(allowed[None].float(), field.coarse_sampler.grid.shape)[0]
        field.coarse_sampler.restrict(coarse > 0)
    config = adapt(config, field.bounds)
    supervision = Supervision(views, field.bounds, config, device_of(field))
    groups = [
        {"params": list(field.encoding.parameters()), "lr": config.learning_rate},
        {
            "params": [*field.geometry.parameters(), *field.colour.parameters()],
            "lr": config.learning_rate / 4,
        },
    ]

    device, rays = device_of(field), dict[bool, int]()  # rays per step, by whether the step is coarse
    lost = torch.zeros((), device=device)

    def is_coarse(step: int) -> bool:
        return config.coarse_every > 0 and step % config.coarse_every == config.coarse_every - 1

    def prepare(step: int) -> tuple[bool, int, int]:
        grids = field.occupancy, field.coarse_sampler
        if step >= config.prune_from and step % config.prune_every == 0:
            for grid in grids:
                grid.prune(config.prune_threshold, grow=step < config.grow_until * config.steps)
        if device.type == "cpu" or step <= SETTLED or step % config.prune_every == 0 or not rays:
            *counts, missed = torch.stack([*(grid.samples_per_ray for grid in grids), lost]).tolist()
            for coarse, grid, samples in zip((False, True), grids, counts, strict=True):
                count = config.samples_per_step / max(samples, 1.0)
                if device.type != "cpu":
                    count /= 1 if grid.observed else 4  # before the first step, rays may cross the whole grid
                    # Only a few different numbers, since each is captured; multiples of 16 reuse compiled kernels.
                    count = 2 ** (math.floor(2 * math.log2(max(count, 1.0))) / 2)
                    count -= count % 16 if count >= 16 else 0
                rays[coarse] = max(1, min(config.rays_at_most, int(count)))
            if missed:
                log.info(f"step {step}: {missed:.0f} samples did not fit into the steps since the last count")
                lost.zero_()
        return is_coarse(step), rays[is_coarse(step)], min(step, SETTLED + 1)

    def outcome(step: int, generator: Generator) -> StepOutcome:
        level: CoarseField | HashGridField = field.levels[0] if is_coarse(step) else field
        batch = supervision.draw(rays[is_coarse(step)], generator)
        samples = level.sampler(batch.rays, generator)
        if may_wait(device) and step >= config.prune_from:
            active = config.coarse_levels if is_coarse(step) else None
            # Once cells are pruned, samples are skipped up to a tenth of the weight at which a cell counts as empty.
            least = 0.1 * config.prune_threshold
            values, seen, density = _visible(field, active, batch.rays, samples, least)
        else:
            if may_wait(device):
                values, seen = query_samples(level, batch.rays, samples), samples
            else:
                room = round(SPARE * config.samples_per_step)
                values, seen = query_packed(level, batch.rays, samples, room)
                lost.add_(samples.valid.sum() - seen.valid.sum())
            density = values.density.detach()
        _update(level.occupancy, batch.rays, samples, density, step, config)
        rendering = render_values(values, seen, batch.background)
        loss, mse = supervision.loss(rendering, batch)
        return StepOutcome(loss, mse, level.occupancy.samples_per_ray)

    with pools_only(device):
        supervision.fit(field, groups, Replayable(prepare, outcome), config.steps, report, seed=config.seed)


@torch.no_grad()
def _update(
    grid: OccupancyGrid,
    rays: Rays,
    samples: RaySamples,
    density: Float[Tensor, "r s"],
    step: int,
    config: HashGridConfig,
) -> None:
    """Update the occupancy grid with the densities of one step's samples, and their rendering weights."""
    # The weights are scaled to samples of one grid step, since concentrated samples are longer or shorter.
    coordinate = grid.bounds.spacing(rays).coordinate
    weights = (
        rendering_weights(density, samples)
        * grid.step
        / (coordinate(samples.ends) - coordinate(samples.starts)).clamp(min=1e-9)
    )
    valid = samples.valid.reshape(-1)
    index = torch.arange(valid.numel(), device=valid.device)
    counted: Tensor | None = valid
    if may_wait(valid.device):  # often most samples are not valid
        index, counted = valid.nonzero()[:, 0], None
    weights, density = (part.reshape(-1).index_select(0, index) for part in (weights, density))
    positions, _ = points_of(rays, samples, index)
    grid.observe(positions, weights.clamp(max=1), density, config.prune_fade, counted)
    grid.samples_per_ray.lerp_(valid.sum() / len(samples.valid), 0.1 if step > SETTLED else 1.0)


def _visible(
    field: HashGridField, active: int | None, rays: Rays, samples: RaySamples, least: float
) -> tuple[FieldValues, RaySamples, Float[Tensor, "r s"]]:
    """Return the values at the samples whose weight is above ``least``, these samples, and the densities at all samples.

    The other samples hardly affect the colours, and their gradients, which are about as small, would hardly change the
    field. Only their density is computed (as in NerfAcc, Li et al. 2023).
    """
    valid = samples.valid.reshape(-1)
    index = valid.nonzero()[:, 0]
    positions, directions = points_of(rays, samples, index)
    encoded = field.encode(positions, active)
    density = encoded.new_zeros(valid.numel()).index_copy(0, index, field.density_of(encoded))
    density = density.view_as(samples.valid)
    weights = rendering_weights(density, samples).reshape(-1).index_select(0, index)
    some = (weights > least).nonzero()[:, 0]
    output = field.values_of(encoded.index_select(0, some), directions.index_select(0, some))
    index = index.index_select(0, some)
    values = FieldValues(
        density.new_zeros(valid.numel()).index_copy(0, index, output.density).view_as(density),
        density.new_zeros(valid.numel(), 3).index_copy(0, index, output.rgb).view(*density.shape, 3),
    )
    seen = torch.zeros_like(valid).index_fill(0, index, True).view_as(samples.valid)
    return values, replace(samples, valid=seen), density


def query_packed(field: RadianceField, rays: Rays, samples: RaySamples, room: int) -> tuple[FieldValues, RaySamples]:
    """Return the field's values at the first ``room`` valid samples (r s), and the samples with only these left valid.

    The field is always queried at ``room`` points, so that the host need not wait for the number of valid samples.
    """
    valid = samples.valid.reshape(-1)
    total, room = valid.numel(), min(room, valid.numel())
    order = valid.cumsum(0)
    selected = valid & (order <= room)
    slot = torch.arange(room, device=valid.device)
    # An empty slot takes some sample of its own, since many gradients for the same point would be added one
    # after another.
    index = torch.cat([slot, slot[:1]]).index_copy(
        0, torch.where(selected, order - 1, room), torch.arange(total, device=valid.device)
    )[:room]
    output = field.query(*points_of(rays, samples, index))
    target = torch.where(slot < order[-1:], index, total)
    density = output.density.new_zeros(total + 1).index_copy(0, target, output.density)[:-1]
    rgb = output.rgb.new_zeros((total + 1, 3)).index_copy(0, target, output.rgb)[:-1]
    values = FieldValues(density.view_as(samples.valid), rgb.view(*samples.valid.shape, 3))
    return values, replace(samples, valid=selected.view_as(samples.valid))
