"""Composing a backend of a config, a field and a recipe, and the config for small scenes that a backend may offer."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import pytest
import torch
from torch import nn

from bidnerf.testing import SCENE_BOUNDS as BOUNDS
from bidnerf.testing import awkward_rays, points
from bidnerf_adanerf import backend as adanerf
from bidnerf_core.backend import RecipeBackend, quick_config
from bidnerf_core.fields import Rays, SceneBounds, render
from bidnerf_core.training import Silent
from bidnerf_hashgrid import HashGridConfig
from bidnerf_hashgrid import backend as hashgrid
from bidnerf_vanilla import backend as vanilla


@dataclass(frozen=True)
class Settings:
    seed: int = 0
    steps: int = 3


class Linear(nn.Module):
    def __init__(self, config: Settings, bounds: object) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 4)


def test_the_seed_alone_decides_the_initial_weights() -> None:
    backend = RecipeBackend("linear", Settings, Linear, lambda field, views, config, report: None)
    before = torch.get_rng_state()
    first, again, other = (backend.build(Settings(seed), BOUNDS).layer.weight for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)


def test_the_recipe_gets_what_train_was_given() -> None:
    given: list[object] = []
    backend = RecipeBackend("linear", Settings, Linear, lambda *arguments: given.extend(arguments))
    field, config, report = backend.build(Settings(), BOUNDS), Settings(5), Silent()
    backend.train(field, [], config, report)
    assert given == [field, [], config, report]


bundled = pytest.mark.parametrize(
    "backend", [vanilla, adanerf, hashgrid], ids=lambda backend: backend.config_type.__name__
)


@bundled
@pytest.mark.parametrize("scale", [0.01, 1000.0])
def test_neither_unit_nor_origin_of_the_world_matters(backend: Any, scale: float) -> None:
    """A scaled and moved world has the same colours at the same places and along the same rays, and absorbs as much."""
    shift = torch.tensor([3.0, -2.0, 5.0]) * scale
    lower, upper = (tuple((torch.tensor(c) * scale + shift).tolist()) for c in (BOUNDS.lower, BOUNDS.upper))
    bounds = SceneBounds(lower, upper, BOUNDS.near * scale, BOUNDS.far * scale)  # type: ignore[arg-type]
    here, there = (backend.build(quick_config(backend), box).requires_grad_(False) for box in (BOUNDS, bounds))
    positions, directions = points(50)
    one, other = here.query(positions, directions), there.query(positions * scale + shift, directions)
    torch.testing.assert_close(other.density * scale, one.density, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(other.rgb, one.rgb, rtol=1e-3, atol=1e-3)
    rays = awkward_rays()["rays from outside"]
    moved = Rays(rays.origins * scale + shift, rays.directions, rays.near * scale, rays.far * scale)
    torch.testing.assert_close(render(there, moved).rgb, render(here, rays).rgb, rtol=0, atol=1e-4)


def test_small_scenes_get_the_settings_that_a_backend_offers_and_else_its_defaults() -> None:
    quick = quick_config(hashgrid)
    changed = {f.name for f in fields(quick) if getattr(quick, f.name) != getattr(HashGridConfig(), f.name)}
    assert changed == {"steps", "colour_layers", "coarse_every"}
    assert quick.steps == 800
    assert quick_config(vanilla) == vanilla.config_type()
    assert quick_config(RecipeBackend("linear", Settings, Linear, lambda *given: None)) == Settings()
