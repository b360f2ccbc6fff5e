"""Training of a hash-grid field: its threads, and its settings in contracted scenes."""

from dataclasses import replace

import pytest
import torch

import tiny
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.fields import RaySamples, SceneBounds, query_samples, render_values, rendering_weights
from bidnerf_core.training import Silent
from bidnerf_hashgrid import HashGridConfig, HashGridField, backend
from bidnerf_hashgrid.recipe import _visible, adapt
from bidnerf_hashgrid.threads import THREADED, pools_only, threads_for
from trainings import assert_same_tensors

BOX = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 6.0)
CPU = torch.device("cpu")
pytestmark = pytest.mark.usefixtures("three_threads")


def trained(threads: int) -> HashGridField:
    torch.set_num_threads(threads)
    views, config = tiny.views(), tiny.config(8, samples_per_step=4 * THREADED, rays_at_most=4 * THREADED)
    field = backend.build(config, estimate_bounds(views, tiny.BACKGROUND))
    backend.train(field, views, config, Silent())
    assert torch.get_num_threads() == threads
    return field


def test_the_number_of_threads_does_not_change_what_is_learned() -> None:
    assert_same_tensors(trained(1).state_dict(), trained(3).state_dict())


def test_pools_keep_the_threads_that_torch_gives_up() -> None:
    with pools_only(CPU):
        assert torch.get_num_threads() == 1
        assert threads_for(THREADED, CPU) == 3
        assert threads_for(THREADED - 1, CPU) == 1
    assert torch.get_num_threads() == 3


def test_pools_follow_torch_again_after_an_error() -> None:
    with pytest.raises(KeyboardInterrupt), pools_only(CPU):
        raise KeyboardInterrupt
    assert torch.get_num_threads() == 3
    torch.set_num_threads(2)
    assert threads_for(THREADED, CPU) == 2


@pytest.mark.parametrize(
    ("footprint", "contracted", "finest"),
    [(0.02, False, 250), (0.02, True, 500), (0.001, False, 1024), (1.0, False, 16), (0.0, False, 1024)],
)
def test_the_finest_level_follows_the_images(footprint: float, contracted: bool, finest: int) -> None:
    """The scene is 2 wide; 2.5 cells are as wide as what a pixel shows, from the coarsest level's 16 cells to 1024 at most."""
    bounds = replace(BOX, footprint=footprint, contracted=contracted)
    assert backend.build(HashGridConfig(), bounds).encoding.levels[-1].resolution == finest
    fixed = backend.build(HashGridConfig(cells_per_pixel=0), bounds)
    assert fixed.encoding.levels[-1].resolution == (2048 if contracted else 1024)


def test_contracted_scenes_are_pruned_later_and_learned_more_slowly() -> None:
    usual = HashGridConfig()
    slower = adapt(usual, replace(BOX, contracted=True))
    assert slower.learning_rate == usual.learning_rate / 2
    assert usual.prune_fade < slower.prune_fade < 1
    assert slower.prune_threshold < usual.prune_threshold
    assert slower.grow_until > usual.grow_until
    kept = replace(usual, grow_until=1.0)
    assert adapt(kept, replace(BOX, contracted=True)).grow_until == 1.0


def test_only_samples_that_are_seen_are_shaded(generator: torch.Generator) -> None:
    """The others change colours by less than their weights, and what they add to gradients is exactly left out."""
    field = backend.build(tiny.config(), BOX)
    rays = BOX.rays(torch.randn((40, 3), generator=generator) / 9, torch.eye(3)[torch.arange(40) % 3])
    borders = torch.linspace(0.2, 0.8, 13).expand(40, -1)
    samples = RaySamples(borders[:, :-1], borders[:, 1:], torch.rand((40, 12), generator=generator) < 0.7)
    whole = query_samples(field, rays, samples)
    weights = rendering_weights(whole.density, samples)
    least = float(weights[samples.valid].detach().median())
    found = {}
    for name, values, seen in (
        ("alone", *_visible(field, None, rays, samples, least)[:2]),
        ("of all", whole, replace(samples, valid=samples.valid & (weights > least))),
    ):
        field.zero_grad()
        rendering = render_values(values, seen, (0.0, 0.0, 0.0))
        rendering.rgb.square().sum().backward()
        found[name] = [rendering.rgb.detach(), *(table.grad.clone() for table in field.encoding.tables)]
    for ours, theirs in zip(*found.values(), strict=True):
        torch.testing.assert_close(ours, theirs)
    everything = render_values(whole, samples, (0.0, 0.0, 0.0))
    assert 0 < float((everything.rgb - found["alone"][0]).detach().abs().max()) < 12 * least
    torch.testing.assert_close(_visible(field, None, rays, samples, 0.0)[2], whole.density.detach())
