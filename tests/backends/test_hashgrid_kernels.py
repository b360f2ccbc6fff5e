"""The kernels for a GPU against the pure-torch path: on a GPU or, where there is none, by Triton's interpreter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import pytest
import torch
from torch import Generator, Tensor
from torch.nn.functional import normalize

from bidnerf_core.devices import without_waiting
from bidnerf_core.fields import Rays, RaySamples, SceneBounds, backward_derivatives, render_samples

# Inside: the kernels and the path that they replace are both reached through parts that choose between them
from bidnerf_hashgrid import fused
from bidnerf_hashgrid.encoding import HashEncodingConfig
from bidnerf_hashgrid.field import FieldConfig, HashGridField
from bidnerf_hashgrid.occupancy import MOST, ConcentratedInGrid, GridDensity, OccupancyGrid

pytest.importorskip("triton")

Interpolation = Literal["linear", "smooth"]
RAYS = 24


DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.fixture(autouse=True)
def kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "available", lambda device: device.type == DEVICE.type)


def by_torch(monkeypatch: pytest.MonkeyPatch, compute: Callable[[], Any]) -> Any:
    with monkeypatch.context() as patch:
        patch.setattr(fused, "available", lambda device: False)
        return compute()


def bounds(contracted: bool) -> SceneBounds:
    return SceneBounds((-1, -2, -1.5), (1.5, 1, 2), 0.1, 20.0, contracted=contracted)


def made(interpolation: Interpolation = "linear", contracted: bool = False, layers: int = 2) -> HashGridField:
    """Return a field with dense and hashed levels, whose sizes are no powers of two, and random tables."""
    torch.manual_seed(0)
    encoding = HashEncodingConfig(
        levels=5, features=3, log2_table_size=13, finest_resolution=64, interpolation=interpolation
    )
    config = FieldConfig(
        encoding=encoding,
        width=24,
        colour_layers=layers,
        geometry_features=6,
        coarse_levels=2,
        grid_resolution=16,
        cells_per_pixel=0,
    )
    found = HashGridField(config, bounds(contracted))
    assert {level.hashed for level in found.encoding.levels} == {False, True}
    for table in found.encoding.tables:
        table.data.uniform_(-1, 1)
    return found.requires_grad_(False).to(DEVICE)


def points(count: int, spread: float, generator: Generator) -> tuple[Tensor, Tensor]:
    """Return points within the box and beyond it, and unit directions."""
    drawn = (torch.randn((count, 3), generator=generator) for _ in range(2))
    return (spread * next(drawn)).to(DEVICE), normalize(next(drawn), dim=-1).to(DEVICE)


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
@pytest.mark.parametrize(("contracted", "layers"), [(False, 2), (True, 1)])
def test_the_field_and_its_derivatives_are_those_of_torch(
    monkeypatch: pytest.MonkeyPatch, generator: Generator, interpolation: Interpolation, contracted: bool, layers: int
) -> None:
    field = made(interpolation, contracted, layers)
    at, along = points(100, 3.0 if contracted else 1.0, generator)
    for level in field.levels:
        found = level.jacobian(at, along)
        expected = by_torch(monkeypatch, lambda level=level: backward_derivatives(level.query, at, along))
        torch.testing.assert_close(found.values.density, expected.values.density, rtol=1e-4, atol=1e-6)
        torch.testing.assert_close(found.values.rgb, expected.values.rgb, rtol=1e-4, atol=1e-6)
        for ours, theirs in (
            (found.by_position, expected.by_position),
            (found.by_direction, expected.by_direction),
        ):
            torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5 * float(theirs.abs().max()))


def test_only_wanted_points_are_computed(generator: Generator) -> None:
    field = made()
    at, along = points(150, 1.0, generator)
    wanted = (torch.rand(150, generator=generator) < 0.3).to(DEVICE)
    every, some = field.jacobian(at, along), field.jacobian(at, along, wanted)
    for ours, theirs in ((some.values.density, every.values.density), (some.by_position, every.by_position)):
        assert torch.equal(ours[wanted], theirs[wanted])
        assert not bool(ours[~wanted].any())
    none = field.jacobian(at, along, torch.zeros_like(wanted))
    assert not bool(none.by_position.any())


def test_rays_are_differentiated_without_a_backward_pass_of_the_field(
    monkeypatch: pytest.MonkeyPatch, generator: Generator
) -> None:
    field = made()
    at, along = points(40, 1.0, generator)
    near = torch.rand((40, 6), generator=generator).to(DEVICE).cumsum(-1)
    samples = RaySamples(near[:, :-1], near[:, 1:] - 0.05, torch.rand((40, 5), generator=generator).to(DEVICE) < 0.7)
    monkeypatch.setattr("bidnerf_core.fields.rendering.may_wait", lambda device: False)

    def gradients() -> tuple[Tensor, ...]:
        rays = Rays(at.clone().requires_grad_(), along.clone().requires_grad_(), near[:, 0], near[:, -1])
        seen = render_samples(field, rays, samples)
        loss = seen.rgb.square().sum() + seen.distance.sum() + (seen.weights**2).sum() + seen.opacity.exp().sum()
        return torch.autograd.grad(loss, (rays.origins, rays.directions))

    expected = by_torch(monkeypatch, gradients)
    monkeypatch.setattr(HashGridField, "query", lambda *given: pytest.fail("a backward pass of the field"))
    for ours, theirs in zip(gradients(), expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5 * float(theirs.abs().max()))


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
@pytest.mark.parametrize("active", [None, 2])
def test_the_encoding_and_its_gradients_are_those_of_torch(
    monkeypatch: pytest.MonkeyPatch, generator: Generator, interpolation: Interpolation, active: int | None
) -> None:
    encoding = made(interpolation).requires_grad_(True).encoding
    at = (1.4 * torch.rand((90, 3), generator=generator) - 0.2).to(DEVICE)
    pull = torch.randn((90, encoding.width), generator=generator).to(DEVICE)

    def computed() -> list[Tensor]:
        encoding.zero_grad()
        leaf = at.clone().requires_grad_()
        values = encoding(leaf, active)
        (values * pull).sum().backward()
        used = list(encoding.tables)[: active or len(encoding.tables)]
        return [values.detach(), leaf.grad, *(table.grad.clone() for table in used)]  # type: ignore[union-attr,list-item]

    for ours, theirs in zip(computed(), by_torch(monkeypatch, computed), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize(
    ("count", "seed", "training"),
    [(8, None, False), (8, 1, True), (32, None, False), (32, 1, True), (MOST, 1, False)],
)
@pytest.mark.filterwarnings("ignore:invalid value encountered in subtract")
def test_samples_are_those_of_torch(
    monkeypatch: pytest.MonkeyPatch,
    generator: Generator,
    contracted: bool,
    count: int,
    seed: int | None,
    training: bool,
) -> None:
    """Rounding may move a step across a cell's border, which changes the samples of a few rays."""
    grid = OccupancyGrid(bounds(contracted), 24, steps_per_cell=1 if contracted else 2)
    grid.peak.copy_(torch.rand(grid.peak.shape, generator=generator))
    grid.density.copy_(3 * torch.rand(grid.peak.shape, generator=generator))
    grid.prune(0.8, grow=False)
    grid.to(DEVICE).train(training)
    origins = 4 * normalize(torch.randn((RAYS, 3), generator=generator), dim=-1)
    aims = 0.7 * torch.randn((RAYS, 3), generator=generator)
    rays = grid.bounds.rays(origins.to(DEVICE), normalize(aims - origins, dim=-1).to(DEVICE))
    monkeypatch.setattr("bidnerf_hashgrid.occupancy.may_wait", lambda device: False)
    monkeypatch.setattr("bidnerf_hashgrid.concentration.may_wait", lambda device: False)
    sampler = grid if count == MOST else ConcentratedInGrid(GridDensity(grid), count)

    def sampled() -> RaySamples:
        return sampler(rays, None if seed is None else torch.Generator(DEVICE).manual_seed(seed))

    with without_waiting():
        found, expected = sampled(), by_torch(monkeypatch, sampled)
    assert found.starts.shape == expected.starts.shape == (RAYS, count)
    assert float(expected.valid.sum(-1).float().mean()) > 3
    same = (found.valid == expected.valid).all(-1)
    for ours, theirs in ((found.starts, expected.starts), (found.ends, expected.ends)):
        same &= ((ours - theirs).abs() * expected.valid).amax(-1) < 1e-4
    assert int((~same).sum()) <= 1
