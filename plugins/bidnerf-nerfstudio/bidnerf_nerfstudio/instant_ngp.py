"""nerfstudio's instant-ngp (Müller et al. 2022): the network of nerfacto, sampled according to an occupancy grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor, nn

from bidnerf_core.backend import RecipeBackend
from bidnerf_core.devices import constant, may_wait
from bidnerf_core.fields import Rays, RaySampler, RaySamples, SceneBounds, device_of, gather_valid, intersect_box
from bidnerf_core.frames import View
from bidnerf_core.settings import Count, NotNegative, Positive, Range
from bidnerf_core.training import Report, StepOutcome, Supervision, SupervisionConfig
from bidnerf_nerfstudio.nerfacto import PlacedSampler
from bidnerf_nerfstudio.networks import HashConfig
from bidnerf_nerfstudio.radiance import PlacedRadiance, RadianceConfig

OCCUPIED = 0.01
"""Optical thickness of a step above which a cell is occupied, or the mean of all cells if that is less."""


@dataclass(frozen=True)
class NgpConfig(RadianceConfig, SupervisionConfig):
    """Size, sampling and training of the field."""

    grid_levels: Annotated[int, Range(1, 16)] = 1  # boxes of cells, each twice as wide as the previous one
    grid_resolution: Annotated[int, Range(2, 1024)] = 128  # cells along each side of a box
    step: Positive = 2 * math.sqrt(3) / 1000  # length of the shortest interval (training units)
    cone_angle: NotNegative = 0.0  # length of an interval at distance 1, if that is larger
    steps: Count = 5000  # steps of the optimizer
    rays_per_step: Count = 1024  # rays of a step
    learning_rate: Positive = 1e-2  # initial learning rate
    seed: Annotated[int, Range(0)] = 0  # seed of the initial weights and of all random draws


class OccupancyLevels(nn.Module):
    """Boxes of cells with a common centre, each twice as wide as the previous one.

    A point is looked up in the smallest that contains it.
    """

    cells: Bool[Tensor, "l n n n"]
    peak: Float[Tensor, "l n n n"]  # optical thickness of a step, the largest observed recently

    def __init__(self, config: NgpConfig) -> None:
        super().__init__()
        lower, upper = config.box[:3], config.box[3:]
        self.centre = tuple((low + high) / 2 for low, high in zip(lower, upper, strict=True))
        self.half = tuple((high - low) / 2 for low, high in zip(lower, upper, strict=True))
        shape = (config.grid_levels, *[config.grid_resolution] * 3)
        self.register_buffer("cells", torch.ones(shape, dtype=torch.bool))
        self.register_buffer("peak", torch.zeros(shape))

    @property
    def widest(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """The corners of the widest box."""
        wide = 2 ** (len(self.cells) - 1)
        pairs = list(zip(self.centre, self.half, strict=True))
        return tuple(c - wide * h for c, h in pairs), tuple(c + wide * h for c, h in pairs)

    def holds(self, positions: Float[Tensor, "*p 3"]) -> Bool[Tensor, "*p"]:
        """Return whether positions (training coordinates) are in an occupied cell."""
        count, resolution = self.cells.shape[:2]
        points = (positions - constant(self.centre, positions)) / constant(self.half, positions)
        size = points.abs().amax(-1)
        level = size.clamp(min=1).log2().ceil().clamp(max=count - 1)
        place = ((points / 2 ** level[..., None] + 1) * (resolution / 2)).long().clamp(0, resolution - 1)
        index = ((level.long() * resolution + place[..., 0]) * resolution + place[..., 1]) * resolution
        found = self.cells.view(-1).index_select(0, (index + place[..., 2]).reshape(-1)).view(size.shape)
        return found & (size <= 2 ** (count - 1))

    @torch.no_grad()
    def look(self, field: NgpField, generator: Generator) -> None:
        """Update the cells from the density at a random place in each."""
        _, resolution = self.cells.shape[:2]
        axis = torch.arange(resolution, device=self.peak.device, dtype=self.peak.dtype)
        corner = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)
        for level in range(len(self.cells)):
            jitter = torch.rand(corner.shape, generator=generator, device=generator.device).to(corner)
            points = ((corner + jitter) * (2 / resolution) - 1) * 2**level
            places = points * constant(self.half, points) + constant(self.centre, points)
            found = field.radiance.density(places.reshape(-1, 3)).reshape(corner.shape[:3])
            # Each update lets the peaks of all cells decay by 5 %.
            self.peak[level] = torch.maximum(0.95 * self.peak[level], field.config.step * found)
        self.cells.copy_(self.peak > self.peak.mean().clamp(max=OCCUPIED))


@dataclass(frozen=True, eq=False)
class OccupiedSteps:
    """Samples along rays in training coordinates: steps in occupied cells, longer ones farther away.

    Steps are uniform in a coordinate that is the distance in steps up to where the cone is one step wide, and
    logarithmic beyond.
    """

    grid: OccupancyLevels
    step: float
    cone_angle: float

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        """Return the intervals in occupied cells."""
        lower, upper = (constant(corner, rays.origins) for corner in self.grid.widest)
        enter, leave = intersect_box(rays.origins, rays.directions, lower, upper)
        near = torch.maximum(rays.near, enter)
        far = torch.maximum(near, torch.minimum(rays.far, leave))
        begin, end = self._place(near)[..., None], self._place(far)[..., None]
        diagonal = math.dist(*self.grid.widest)
        count = math.ceil(float(self._place(torch.tensor(diagonal, dtype=torch.float64)))) + 1
        borders = torch.arange(-1, count, dtype=near.dtype, device=near.device).expand(*near.shape, -1)
        if jitter is not None:
            borders = borders + torch.rand((*near.shape, 1), generator=jitter, device=jitter.device).to(near)
        else:
            borders = borders + 1
        distances = self._distance(torch.minimum((begin + borders).clamp(min=0), end))
        distances = torch.minimum(torch.maximum(distances, near[..., None]), far[..., None])
        samples = RaySamples(distances[..., :-1], distances[..., 1:], distances[..., 1:] > distances[..., :-1])
        kept = samples.valid & self.grid.holds(rays.at(samples.middles))
        samples = RaySamples(samples.starts, samples.ends, kept & (rays.far > rays.near)[..., None])
        if not may_wait(near.device):
            return samples
        width = int(samples.valid.sum(-1).amax()) if near.numel() else 0
        return RaySamples(*(part[..., :width] for part in gather_valid(samples).parts))

    def _place(self, distance: Tensor) -> Tensor:
        if not self.cone_angle:
            return distance / self.step
        turn = self.step / self.cone_angle  # distance at which the steps begin to grow
        beyond = (distance / turn).clamp(min=1).log() / math.log1p(self.cone_angle)
        return distance.clamp(max=turn) / self.step + beyond

    def _distance(self, place: Tensor) -> Tensor:
        if not self.cone_angle:
            return place * self.step
        turn = 1 / self.cone_angle
        beyond = (place - turn).clamp(min=0) * math.log1p(self.cone_angle)
        return place.clamp(max=turn) * self.step * beyond.exp()


class NgpField(PlacedRadiance):
    """The field of a run of instant-ngp."""

    config: NgpConfig

    def __init__(self, config: NgpConfig, bounds: SceneBounds) -> None:
        super().__init__(config, bounds)
        self.grid = OccupancyLevels(config)

    @property
    def sampler(self) -> RaySampler:
        """The sampler of rays in the world."""
        return PlacedSampler(OccupiedSteps(self.grid, self.config.step, self.config.cone_angle), self.placement)


def train(field: NgpField, views: Sequence[View], config: NgpConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` on checkpoints and stopping."""
    supervision = Supervision(views, field.bounds, config, device_of(field))

    def outcome(step: int, generator: Generator) -> StepOutcome:
        if step and step % 16 == 0:  # the grid is updated every 16 steps
            field.grid.look(field, generator)
        return supervision.step(field, config.rays_per_step, generator)

    groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
    supervision.fit(field, groups, outcome, config.steps, report, seed=config.seed)


backend = RecipeBackend(
    "instant-ngp of nerfstudio: imported runs, or trained here",
    NgpConfig,
    NgpField,
    train,
    NgpConfig(encoding=HashConfig(8, 2, 15, 16, 256), grid_resolution=32, step=2 * math.sqrt(3) / 128, steps=800),
)
