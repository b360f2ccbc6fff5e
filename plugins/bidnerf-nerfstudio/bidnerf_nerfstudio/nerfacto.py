"""nerfacto (Tancik et al. 2023): a hash-encoded field whose samples are placed by proposal networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from bidnerf_core.backend import RecipeBackend
from bidnerf_core.errors import InputError
from bidnerf_core.fields import Rays, RaySampler, RaySamples, SceneBounds, device_of, render_samples
from bidnerf_core.frames import View
from bidnerf_core.settings import Count, Positive, Range
from bidnerf_core.training import Report, StepOutcome, Supervision, SupervisionConfig
from bidnerf_nerfstudio.networks import HashConfig, HashNetwork, density_of, unit_cube
from bidnerf_nerfstudio.placement import Placement
from bidnerf_nerfstudio.proposals import ProposalSampler, Spacing, interlevel_loss
from bidnerf_nerfstudio.radiance import PlacedRadiance, RadianceConfig

PROPOSALS = tuple(HashConfig(5, 2, 17, 16, finest, 16, 2) for finest in (128, 256))


@dataclass(frozen=True)
class NerfactoConfig(RadianceConfig, SupervisionConfig):
    """Size, sampling and training of the field."""

    proposals: tuple[HashConfig, ...] = PROPOSALS  # networks that place the samples, in order
    proposal_samples: tuple[int, ...] = (256, 96)  # samples of each along a ray
    samples: Count = 48  # samples of the field along a ray
    spacing: Spacing = "piecewise"  # spacing of the first network's samples: uniform up to distance 1 and in the inverse beyond, or uniform
    steps: Count = 5000  # steps of the optimizer
    rays_per_step: Count = 1024  # rays of a step
    learning_rate: Positive = 1e-2  # initial learning rate
    seed: Annotated[int, Range(0)] = 0  # seed of the initial weights and of all random draws

    def __post_init__(self) -> None:
        super().__post_init__()
        if not len(self.proposals) == len(self.proposal_samples) > 0:
            raise InputError(
                f"proposal_samples has {len(self.proposal_samples)} numbers",
                expected=f"one for each of {len(self.proposals)} proposals, and at least one",
            )
        if min(self.proposal_samples) < 2:
            raise InputError(f"proposal_samples is {self.proposal_samples}", expected="numbers of at least 2")


class Proposal(nn.Module):
    """A density without colour."""

    def __init__(self, config: HashConfig, box: SceneBounds, factor: float) -> None:
        super().__init__()
        self.box, self.factor = box, factor
        self.network = HashNetwork(config, 1)

    def forward(self, positions: Float[Tensor, "p 3"]) -> Float[Tensor, "p"]:
        """Return densities per training unit."""
        points, inside = unit_cube(positions, self.box)
        return density_of(self.network(points)[:, 0], self.factor) * inside


class NerfactoField(PlacedRadiance):
    """The field of a nerfacto run."""

    config: NerfactoConfig

    def __init__(self, config: NerfactoConfig, bounds: SceneBounds) -> None:
        super().__init__(config, bounds)
        self.proposals = nn.ModuleList(
            Proposal(each, self.radiance.box, config.initial_density) for each in config.proposals
        )

    @property
    def trained_sampler(self) -> ProposalSampler:
        """The sampler of rays in training coordinates."""
        config = self.config
        return ProposalSampler(tuple(self.proposals), config.proposal_samples, config.samples, config.spacing)

    @property
    def sampler(self) -> RaySampler:
        """The sampler of rays in the world."""
        return PlacedSampler(self.trained_sampler, self.placement)


@dataclass(frozen=True, eq=False)
class PlacedSampler:
    """A sampler in training coordinates, for rays in the world."""

    sampler: RaySampler
    placement: Placement

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        """Return the samples of rays in the world."""
        return self.placement.samples(self.sampler(self.placement.rays(rays), jitter))


def train(field: NerfactoField, views: Sequence[View], config: NerfactoConfig, report: Report) -> None:
    """Fit ``field`` to ``views``; see ``fit`` on checkpoints and stopping."""
    supervision = Supervision(views, field.bounds, config, device_of(field))

    def outcome(step: int, generator: Generator) -> StepOutcome:
        batch = supervision.draw(config.rays_per_step, generator)
        rays, sampler = field.placement.rays(batch.rays), field.trained_sampler
        borders, proposed = sampler.proposed(rays, generator)
        samples = field.placement.samples(sampler.samples(rays, borders))
        rendering = render_samples(field, batch.rays, samples, batch.background)
        loss, mse = supervision.loss(rendering, batch)
        for each in proposed:
            loss = loss + interlevel_loss(borders, rendering.weights, each)
        return StepOutcome(loss, mse, float(samples.valid.sum() / len(batch)))

    groups = [{"params": list(field.parameters()), "lr": config.learning_rate}]
    supervision.fit(field, groups, outcome, config.steps, report, seed=config.seed)


backend = RecipeBackend(
    "nerfacto of nerfstudio: imported runs, or trained here",
    NerfactoConfig,
    NerfactoField,
    train,
    NerfactoConfig(
        encoding=HashConfig(8, 2, 15, 16, 256),
        proposals=tuple(HashConfig(4, 2, 13, 16, n, 16) for n in (64, 128)),
        proposal_samples=(64, 32),
        samples=24,
        steps=800,
    ),
)
