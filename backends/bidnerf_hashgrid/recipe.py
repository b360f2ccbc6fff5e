"""Training of a hash-grid field: its settings and its recipe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

from torch import Generator

from bidnerf_core.carving import occupied_voxels
from bidnerf_core.errors import InputError
from bidnerf_core.fields import Rendering, SceneBounds, device_of, render
from bidnerf_core.frames import View
from bidnerf_core.settings import Count, NotNegative, Positive, Range
from bidnerf_core.training import Report, StepOutcome, Supervision, SupervisionConfig, TrainingBatch
from bidnerf_hashgrid.field import CoarseField, FieldConfig, HashGridField
from bidnerf_hashgrid.occupancy import OccupancyGrid
from bidnerf_hashgrid.threads import pools_only


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
    seed: Annotated[int, Range(0)] = 0  # seed of the initial weights and of all random draws
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
            raise InputError(
                "coarse_every is 1", expected="0 or 2 and more: the field itself would not be trained"
            )
        if self.coarse_every > self.prune_every:
            raise InputError(
                f"coarse_every is {self.coarse_every}", expected=f"{self.prune_every} (prune_every) or less"
            )


def adapted(config: HashGridConfig, bounds: SceneBounds) -> HashGridConfig:
    """Return the config with slower pruning, and half the learning rate, if the scene is contracted.

    There, a ray crosses many cells, hardly any of which depth or silhouettes have shown to be empty, and a
    cell that is pruned too early is rarely found again. Training at the full rate was less stable there: of
    twelve unseen photos of a phone capture, one lost 5 dB.
    """
    if not bounds.contracted:
        return config
    return replace(
        config, learning_rate=config.learning_rate / 2, prune_fade=config.prune_fade**0.4,
        prune_threshold=config.prune_threshold / 5, grow_until=max(config.grow_until, 0.9),
    )  # fmt: skip


def train(field: HashGridField, views: Sequence[View], config: HashGridConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` on checkpoints and stopping."""
    if config.carve and report.resume() is None:
        for grid in (field.occupancy, field.coarse_sampler):
            grid.restrict(occupied_voxels(views, grid.grid))
    config = adapted(config, field.bounds)
    supervision = Supervision(views, field.bounds, config, device_of(field))
    groups = [
        {"params": list(field.encoding.parameters()), "lr": config.learning_rate},
        {
            "params": [*field.geometry.parameters(), *field.colour.parameters()],
            "lr": config.learning_rate / 4,
        },
    ]

    def outcome(step: int, generator: Generator) -> StepOutcome:
        coarse = config.coarse_every > 0 and step % config.coarse_every == config.coarse_every - 1
        level: CoarseField | HashGridField = field.levels[0] if coarse else field
        grid = level.occupancy
        affordable = int(config.samples_per_step / float(grid.samples_per_ray.clamp(min=1)))
        count = max(1, min(config.rays_at_most, affordable))
        batch = supervision.draw(count, generator)
        rendering = render(level, batch.rays, batch.background, generator)
        _update(grid, batch, rendering, step, config)
        loss, mse = supervision.loss(rendering, batch)
        return StepOutcome(loss, mse, float(grid.samples_per_ray))

    with pools_only(device_of(field)):
        supervision.fit(field, groups, outcome, config.steps, report, seed=config.seed)


def _update(
    grid: OccupancyGrid, batch: TrainingBatch, rendering: Rendering, step: int, config: HashGridConfig
) -> None:
    """Update the occupancy grid with one step's rendering."""
    samples, density = rendering.samples, rendering.density
    assert density is not None  # it comes from ``render``
    # Weights as if samples were one grid step long: concentrated samples are longer or shorter.
    place = grid.bounds.spacing(batch.rays).place
    weights = (
        rendering.weights.detach() * grid.step / (place(samples.ends) - place(samples.starts)).clamp(min=1e-9)
    )
    ray, slot = samples.valid.nonzero(as_tuple=True)
    index = ray * samples.valid.shape[1] + slot
    middles, weights, density = (
        part.detach().reshape(-1).index_select(0, index) for part in (samples.middles, weights, density)
    )
    origins, directions = (part.index_select(0, ray) for part in (batch.rays.origins, batch.rays.directions))
    positions = origins + middles[:, None] * directions
    grid.observe(positions, weights.clamp(max=1), density, config.prune_fade)
    grid.samples_per_ray.lerp_(samples.valid.sum() / len(samples.valid), 0.1 if step > 10 else 1.0)
    if step >= config.prune_from and step % config.prune_every in (0, config.coarse_every - 1):
        grid.prune(config.prune_threshold, grow=step < config.grow_until * config.steps)
