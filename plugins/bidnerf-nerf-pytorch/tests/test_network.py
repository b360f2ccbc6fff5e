"""The network, compared with the original's formulas written out."""

from __future__ import annotations

import math

import pytest
import torch

from bidnerf_core.fields import encoding_width
from bidnerf_nerf_pytorch.network import Network, NetworkConfig, encoded


@pytest.mark.parametrize("octaves", [True, False])
@pytest.mark.parametrize("include_input", [True, False])
@pytest.mark.parametrize("frequencies", [0, 1, 2, 5])
def test_encoding_is_that_of_nerf_pytorch(frequencies: int, include_input: bool, octaves: bool) -> None:
    """All sines of a frequency, then its cosines; frequencies 1, 2, 4 ... or in equal steps; no pi."""
    points = torch.randn(7, 3, dtype=torch.float64)
    last = 2.0 ** (frequencies - 1)
    if octaves:
        factors = [2.0**k for k in range(frequencies)]
    else:
        factors = torch.linspace(1, last, frequencies, dtype=torch.float64).tolist()
    found = encoded(points, frequencies, include_input, octaves)
    assert found.shape == (7, encoding_width(frequencies, include_input))
    for row, point in zip(found.tolist(), points.tolist(), strict=True):
        expected = list(point) if include_input else []
        for factor in factors:
            expected += [math.sin(factor * x) for x in point] + [math.cos(factor * x) for x in point]
        assert row == pytest.approx(expected, abs=1e-12)


def test_forward_goes_the_way_of_the_original() -> None:
    """No activation after the first layer; the hidden layer goes before the position where both are fed in."""
    net = Network(NetworkConfig(4, 8, (2,), 2, True, 1, False)).double()
    points, directions = torch.randn(5, 3).double(), torch.randn(5, 3).double()
    xyz, view = encoded(points, 2, True, True), encoded(directions, 1, False, True)
    x = net.layer1(xyz)
    x = torch.relu(net.layers_xyz[0](x))
    x = torch.relu(net.layers_xyz[1](torch.cat((x, xyz), dim=-1)))
    x = torch.relu(net.layers_xyz[2](x))
    looked = torch.relu(net.layers_dir[0](torch.cat((torch.relu(net.fc_feat(x)), view), dim=-1)))
    density, rgb = net(points, directions)
    torch.testing.assert_close(density, net.fc_alpha(x)[:, 0])
    torch.testing.assert_close(rgb, net.fc_rgb(looked))


def test_colour_without_directions() -> None:
    net = Network(NetworkConfig(layers=2, width=8, view_dependent=False))
    points = torch.randn(5, 3)
    density, rgb = net(points, torch.randn(5, 3))
    again = net(points, torch.randn(5, 3))
    assert density.shape == (5,)
    assert rgb.shape == (5, 3)
    assert torch.equal(again[0], density)
    assert torch.equal(again[1], rgb)


@pytest.mark.parametrize("view_dependent", [True, False])
def test_an_untrained_network_is_fog_everywhere(view_dependent: bool) -> None:
    """A network that begins without density would have no gradient by which to gain any."""
    net = Network(NetworkConfig(view_dependent=view_dependent))
    density, rgb = net(torch.rand(500, 3) * 4 - 2, torch.randn(500, 3))
    assert float(density.detach().min()) > 0
    assert float(rgb.detach().abs().max()) < 1
