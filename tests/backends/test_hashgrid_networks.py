"""The networks of the hash grid, evaluated in chunks: they agree with the modules, and their derivatives with numerical ones."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from bidnerf_hashgrid import networks
from bidnerf_hashgrid.networks import log_density_and_rgb


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(networks, "NETWORK_CHUNK", 8)


def made(colour_layers: int = 2) -> tuple[nn.Sequential, nn.Sequential]:
    """Random networks in float64."""
    torch.manual_seed(0)
    hidden = [nn.Linear(5 + 4, 7), nn.ReLU()]
    for _ in range(colour_layers - 1):
        hidden += [nn.Linear(7, 7), nn.ReLU()]
    geometry = nn.Sequential(nn.Linear(6, 7), nn.ReLU(), nn.Linear(7, 1 + 5)).double()
    return geometry, nn.Sequential(*hidden, nn.Linear(7, 3), nn.Sigmoid()).double()


def inputs(count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(1)
    encoded, harmonics = (torch.randn((count, k), generator=generator, dtype=torch.float64) for k in (6, 4))
    return encoded.requires_grad_(), harmonics.requires_grad_()


def by_modules(
    geometry: nn.Sequential, colour: nn.Sequential, encoded: Tensor, harmonics: Tensor
) -> tuple[Tensor, Tensor]:
    features = geometry(encoded)
    return features[:, 0], colour(torch.cat([features[:, 1:], harmonics], dim=-1))


def gradients(found: tuple[Tensor, Tensor], of: list[Tensor]) -> tuple[Tensor, ...]:
    """Gradients of an unsymmetric function of both results."""
    log_density, rgb = found
    weights = torch.tensor([1.0, -2.0, 0.7], dtype=torch.float64)
    loss = (log_density.sin().sum() + (rgb**2 @ weights).sum()) * 3
    return torch.autograd.grad(loss, of)


@pytest.mark.parametrize("colour_layers", [1, 2, 3])
@pytest.mark.parametrize("count", [0, 1, 8, 21])
def test_agrees_with_the_modules(count: int, colour_layers: int) -> None:
    geometry, colour = made(colour_layers)
    points = inputs(count)
    of = [*points, *geometry.parameters(), *colour.parameters()]
    found, expected = (f(geometry, colour, *points) for f in (log_density_and_rgb, by_modules))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other)
    for one, other in zip(gradients(found, of), gradients(expected, of), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_derivatives_equal_numerical_ones() -> None:
    geometry, colour = made()
    parameters = [*geometry.parameters(), *colour.parameters()]
    assert torch.autograd.gradcheck(
        lambda encoded, harmonics, *_: log_density_and_rgb(geometry, colour, encoded, harmonics),
        (*inputs(11), *parameters),
    )


@pytest.mark.parametrize("frozen", ["networks", "inputs", "encoding", "all but one weight"])
def test_what_is_frozen_gets_no_gradient_and_changes_no_other(frozen: str) -> None:
    geometry, colour = made()
    encoded, harmonics = inputs(21)
    if frozen == "networks":
        geometry.requires_grad_(False)
        colour.requires_grad_(False)
    elif frozen == "all but one weight":
        for part in (*list(geometry.parameters())[1:], *colour.parameters(), encoded, harmonics):
            part.requires_grad_(False)
    else:
        encoded.requires_grad_(False)
        harmonics.requires_grad_(frozen == "encoding")
    everything = [encoded, harmonics, *geometry.parameters(), *colour.parameters()]
    of = [part for part in everything if part.requires_grad]
    assert 0 < len(of) < len(everything)
    found, expected = (
        gradients(f(geometry, colour, encoded, harmonics), of) for f in (log_density_and_rgb, by_modules)
    )
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_refuses_double_backward() -> None:
    geometry, colour = made()
    encoded, harmonics = inputs(3)
    _, rgb = log_density_and_rgb(geometry, colour, encoded, harmonics)
    (first,) = torch.autograd.grad(rgb.square().sum(), encoded, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        first.sum().backward()
