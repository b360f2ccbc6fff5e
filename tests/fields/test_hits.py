"""Fields that find for whole rays what they meet: rendering and the contract's check of them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from bidnerf.testing import check_hits
from bidnerf_core.fields import (
    FieldValues,
    HitField,
    RayHits,
    Rays,
    Stratified,
    render,
)

SOFT = 0.01  # metres: standard deviation of the density about a sheet
HEIGHTS = (0.4, -0.3)  # metres
ALPHA = 0.6


@dataclass(frozen=True)
class Sheets:
    """Two level sheets that stop the same share of any ray, with colours that vary smoothly over them."""

    sampler: Stratified = Stratified(64)

    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        slope = directions[..., 2].abs()
        density = torch.zeros_like(slope)
        for height in HEIGHTS:
            away = (positions[..., 2] - height) / SOFT
            profile = torch.exp(-0.5 * away.square()) / (math.sqrt(2 * math.pi) * SOFT)
            density = density - math.log(1 - ALPHA) * slope * profile
        return FieldValues(density, self.colour(positions))

    @staticmethod
    def colour(positions: Tensor) -> Tensor:
        return torch.sigmoid(3 * positions)

    def hits(self, rays: Rays) -> RayHits:
        slope = rays.directions[..., 2:]
        heights = rays.origins.new_tensor(HEIGHTS)
        distance = (heights - rays.origins[..., 2:]) / slope
        distance, _ = distance.sort(dim=-1)
        valid = (distance > rays.near[..., None]) & (distance < rays.far[..., None])
        # those that count come first
        distance, order = torch.where(valid, distance, torch.inf).sort(dim=-1)
        valid = valid.gather(-1, order)
        distance = torch.where(valid, distance, rays.near[..., None])
        return RayHits(distance, ALPHA * valid.to(distance), self.colour(rays.at(distance)), valid)


@dataclass(frozen=True)
class Changed(Sheets):
    """Sheets whose hits are changed afterwards."""

    change: Callable[[RayHits], RayHits] = lambda hits: hits

    def hits(self, rays: Rays) -> RayHits:
        return self.change(super().hits(rays))


def rays(count: int = 12) -> Rays:
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor([0.0, 0, 2]) + 0.3 * torch.randn((count, 3), generator=generator)
    targets = 0.5 * torch.randn((count, 3), generator=generator)
    directions = torch.nn.functional.normalize(targets * torch.tensor([1.0, 1, 0]) - origins, dim=-1)
    return Rays(*(x.double() for x in (origins, directions, torch.zeros(count), torch.full((count,), 9.0))))


def test_hits_are_composited_from_the_nearest_on() -> None:
    field = Sheets()
    assert isinstance(field, HitField)
    hits = field.hits(rays())
    found = render(field, rays(), (1.0, 1.0, 1.0))
    first, second = hits.rgb.unbind(1)
    expected = ALPHA * first + (1 - ALPHA) * ALPHA * second + (1 - ALPHA) ** 2
    assert torch.allclose(found.rgb, expected)
    assert torch.allclose(found.opacity, torch.tensor(1 - (1 - ALPHA) ** 2).double())
    assert torch.allclose(found.distance, ALPHA * (hits.distance @ torch.tensor([1, 1 - ALPHA]).double()))


def test_rays_that_meet_nothing_see_the_background() -> None:
    found = render(Sheets(), replace(rays(), directions=-rays().directions), (0.1, 0.2, 0.3))
    assert torch.allclose(found.rgb, torch.tensor([0.1, 0.2, 0.3]).double().expand_as(found.rgb))


def test_the_contract_accepts_them_and_names_what_is_wrong() -> None:
    check_hits(Sheets())
    changes: dict[str, Callable[[RayHits], RayHits]] = {
        r"outside of \[0, 1\]": lambda hits: replace(hits, alpha=1.5 * hits.alpha / ALPHA),
        "light of rays": lambda hits: replace(hits, alpha=0.5 * hits.alpha),
        "where a hit is not valid": lambda hits: replace(hits, alpha=torch.full_like(hits.alpha, ALPHA)),
        "outside .near, far.": lambda hits: replace(hits, distance=hits.distance + 100),
    }
    for message, change in changes.items():
        with pytest.raises(AssertionError, match=message):
            check_hits(Changed(change=change))
