"""NeRF: encoding, network, hierarchical sampling, room for matter, and a training that learns."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bidnerf.testing import SCENE_BOUNDS as BOUNDS
from bidnerf.testing import SIDE, BackendContract, Recorder, rgbd_views
from bidnerf_core.carving import occupied_voxels
from bidnerf_core.errors import InputError
from bidnerf_core.fields import (
    RaySamples,
    encoding_width,
    frequency_encoding,
    levels,
    octaves,
    render,
)
from bidnerf_core.training import RayBank, Supervision, ray_termination, supervised_loss
from bidnerf_vanilla import VanillaConfig, VanillaField, backend
from bidnerf_vanilla.field import OccupiedOnly
from bidnerf_vanilla.network import NerfNetwork, NetworkConfig
from simulated_device import StaysOnDevice
from small_backends import VANILLA

SMALL = replace(VANILLA, layers=3, coarse_samples=24, steps=60)


class TestVanilla(StaysOnDevice, BackendContract):
    backend = backend
    config = replace(SMALL, samples_per_step=1024)


def built(**changes: object) -> VanillaField:
    return backend.build(replace(SMALL, **changes), BOUNDS)  # type: ignore[arg-type]


def rays_of_view(count: int = 200):  # type: ignore[no-untyped-def]
    return RayBank(rgbd_views(), BOUNDS).draw(count, torch.Generator().manual_seed(0)).rays


# Encoding.


@pytest.mark.parametrize("include_input", [True, False])
@pytest.mark.parametrize("frequencies", [0, 1, 4, 10])
def test_encoding_is_equation_4(frequencies: int, include_input: bool) -> None:
    given = torch.rand(9, 3, dtype=torch.float64) * 2 - 1
    found = frequency_encoding(given, octaves(frequencies, given), include_input)
    assert found.shape == (9, encoding_width(frequencies, include_input))
    for row, point in zip(found.tolist(), given.tolist(), strict=True):
        expected = list(point) if include_input else []
        for k in range(frequencies):
            expected += [math.sin(2**k * math.pi * x) for x in point]
            expected += [math.cos(2**k * math.pi * x) for x in point]
        assert row == pytest.approx(expected, abs=1e-10)


def test_the_order_of_sines_and_cosines_is_all_that_differs() -> None:
    given = torch.rand(5, 2, 3)
    found = frequency_encoding(given, octaves(4, given), False, sines_first=True).unflatten(-1, (2, 4, 3))
    usual = frequency_encoding(given, octaves(4, given), False).unflatten(-1, (4, 2, 3))
    assert torch.equal(found, usual.transpose(-3, -2))


# The network.


@pytest.mark.parametrize(("skip", "fed"), [(0, False), (1, True), (2, True), (3, False), (9, False)])
def test_the_position_comes_again_after_skip_layers(skip: int, fed: bool) -> None:
    """What the layers before forget does not matter to one that is fed the position itself."""
    net = NerfNetwork(NetworkConfig(3, 16, skip, 2, 1))
    torch.nn.init.zeros_(net.trunk[0].weight)
    given = torch.rand(20, 3)
    density, _ = net(given, torch.rand(20, 3))
    assert (float(density.detach().std()) > 1e-6) == fed


def test_density_does_not_depend_on_the_direction_and_colour_does() -> None:
    net = NerfNetwork(NetworkConfig())
    given = torch.rand(20, 3)
    (density, rgb), (again, other) = net(given, torch.rand(20, 3)), net(given, -torch.rand(20, 3))
    assert torch.equal(density, again)
    assert bool((rgb != other).any())


# The field.


def test_an_untrained_field_is_nearly_transparent() -> None:
    rays = rays_of_view()
    across = rays.far > rays.near
    for level in levels(built()):
        opacity = render(level, rays).opacity
        assert 0.5 < float(opacity[across].mean()) < 0.9999
        assert float(opacity[~across].abs().sum()) == 0


# Hierarchical sampling.


def test_more_samples_go_near_the_surface() -> None:
    """The coarse network is a wall at x = 0: most of the samples that the fine level adds are at its front."""
    field = built(coarse_samples=32, fine_samples=32, position_frequencies=0).double()
    with torch.no_grad():
        for parameter in field.coarse.parameters():
            parameter.zero_()
        field.coarse.network.trunk[0].weight[0, 0] = 1.0
        for layer in list(field.coarse.network.trunk)[1:]:
            layer.weight[0, 0] = 1.0
        field.coarse.network.density.weight[0, 0] = 5000.0
        field.coarse.network.density.bias[0] = -20.0
    bounds = field.bounds
    origins = torch.tensor([[-3.0, 0.1, 0.2]], dtype=torch.float64)
    rays = bounds.rays(origins, torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64))
    rough, placed = field.coarse.sampler(rays), field.sampler(rays)
    step = float(rays.far - rays.near) / 32

    def near_front(samples: RaySamples) -> int:
        return int(((samples.middles - 3.0).abs() < 1.5 * step).sum())

    assert placed.starts.shape == (1, 64)
    assert near_front(placed) >= near_front(rough) + 28


def test_no_gradient_flows_through_the_choice_of_place() -> None:
    field = built()
    render(field, rays_of_view()).rgb.sum().backward()
    assert all(p.grad is None for p in field.coarse.parameters())
    assert all(p.grad is not None for p in field.fine.parameters())


# Room for matter.


def test_no_point_is_queried_outside_the_room() -> None:
    field = built()
    field.room.cells.copy_(occupied_voxels(rgbd_views(), field.room.grid))
    rays = rays_of_view()
    for level in levels(field):
        assert isinstance(level.sampler, OccupiedOnly)
        everywhere, found = level.sampler.sampler(rays), level.sampler(rays)
        assert torch.equal(found.starts, everywhere.starts)
        held = field.room.holds(rays.at(found.middles))
        assert torch.equal(found.valid, everywhere.valid & held)
        possible = int((rays.far > rays.near).sum()) * found.valid.shape[-1]
        assert int(found.valid.sum()) < 0.6 * possible


# Training.


def test_what_is_compared_with_measured_depth() -> None:
    """One ray: the mean distance of its weight from the measurement, what it lacks counted as at the camera."""
    field = built()
    batch = RayBank(rgbd_views(), BOUNDS).draw(300, torch.Generator().manual_seed(0))
    rendering = render(field, batch.rays, batch.background)
    total, count = 0.0, 0
    for w, t, d in zip(rendering.weights, rendering.samples.middles, batch.observed.distance, strict=True):
        if d > 0:
            total += float((w * (t - d).abs()).sum() + (1 - w.sum()) * d)
            count += 1
    assert count > 10
    assert float(ray_termination(rendering, batch)) == pytest.approx(total / count, rel=1e-4)
    loss, mse = supervised_loss(rendering, batch, SIDE, 0.5)
    assert float(mse) == pytest.approx(float(((rendering.rgb - batch.observed.rgb) ** 2).mean()))
    assert float(loss) == pytest.approx(float(mse) + 0.5 * total / count / SIDE, rel=1e-4)


def test_both_levels_learn_from_a_step() -> None:
    field = built()
    generator = torch.Generator().manual_seed(0)
    supervision = Supervision(rgbd_views(), BOUNDS, SMALL)
    outcome = supervision.step(field, 64, generator)
    outcome.loss.backward()
    assert all(float(p.grad.abs().sum()) > 0 for p in field.parameters() if p.grad is not None)
    assert all(p.grad is not None for p in field.parameters())
    assert outcome.samples_per_ray > 0


def test_a_step_takes_more_rays_where_there_is_little_room() -> None:
    counted = []
    for carve in (True, False):
        report = Recorder()
        config = replace(SMALL, steps=3, carve=carve, rays_at_most=100_000, coarse_samples=48)
        backend.train(built(coarse_samples=48), rgbd_views(), config, report)
        counted.append(report.steps[-1].samples_per_ray)
    assert counted[0] < 0.7 * counted[1]


# Configuration.


def test_an_encoding_of_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="expected one of them"):
        VanillaConfig(position_frequencies=0, include_input=False)
