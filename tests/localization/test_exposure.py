"""Exposure: weighted least squares with priors, against numpy, under outliers; and measured points with the exposure of the map.

An exposure is estimated inside of costs and shows in no answer, hence ``fit_exposure``, ``robust_exposure`` and their use on points.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

import baked
from bidnerf_core.geometry import SE3, Robust
from bidnerf_core.localization import PointCloud, PointScales, SurfaceCost

# Inside: fits of the exposure are compared with numpy's least squares
from bidnerf_core.localization.by_depth import STRONGEST, cloud_with_exposure_of_map
from bidnerf_core.localization.exposure import clipped, fit_exposure, robust_exposure


@pytest.mark.parametrize(
    ("gain_precision", "bias_precision"), [(0.0, 0.0), (25.0, 100.0), (7.0, 0.0), (0.0, 3.0)]
)
def test_it_is_numpys_least_squares_with_the_priors_as_rows(
    gain_precision: float, bias_precision: float, generator: Generator
) -> None:
    rendered = torch.rand((2, 3, 50), generator=generator, dtype=torch.float64)
    measured = torch.rand((1, 3, 50), generator=generator, dtype=torch.float64)
    weights = torch.rand((2, 1, 50), generator=generator, dtype=torch.float64)
    found = fit_exposure(rendered, measured, weights, gain_precision, bias_precision)
    for h in range(2):
        for c in range(3):
            root = weights[h, 0].sqrt().numpy()
            x, y = rendered[h, c].numpy(), measured[0, c].numpy()
            priors = np.sqrt([gain_precision, bias_precision])
            rows = np.concatenate([root[:, None] * np.stack([x, np.ones_like(x)], -1), np.diag(priors)])
            values = np.concatenate([root * y, priors * [1.0, 0.0]])
            (gain, bias), *_ = np.linalg.lstsq(rows, values, rcond=None)
            assert float(found.gain[h, c]) == pytest.approx(gain, rel=1e-9)
            assert float(found.bias[h, c]) == pytest.approx(bias, rel=1e-9, abs=1e-12)


def test_a_precision_for_each_pose() -> None:
    rendered = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64).expand(2, 1, 3)
    weights = torch.ones((2, 1, 3), dtype=torch.float64)
    found = fit_exposure(rendered, 2 * rendered, weights, torch.tensor([[0.0], [1e9]], dtype=torch.float64))
    torch.testing.assert_close(found.gain[:, 0], torch.tensor([2.0, 1.0], dtype=torch.float64))


def test_without_any_weight_there_is_no_correction() -> None:
    rendered = torch.rand((1, 3, 10), dtype=torch.float64)
    found = fit_exposure(rendered, rendered + 0.3, torch.zeros((1, 1, 10), dtype=torch.float64), 0.0)
    torch.testing.assert_close(found.applied(rendered), rendered)


def test_a_single_colour_leaves_the_gain_to_the_prior() -> None:
    rendered = torch.full((1, 3, 10), 0.5, dtype=torch.float64)
    found = fit_exposure(rendered, rendered + 0.1, torch.ones((1, 1, 10), dtype=torch.float64), 1e-3)
    torch.testing.assert_close(found.applied(rendered), rendered + 0.1)
    torch.testing.assert_close(found.gain, torch.ones((1, 3), dtype=torch.float64))


def colours(generator: Generator) -> Tensor:
    return torch.rand((1, 3, 500), generator=generator, dtype=torch.float64)


ALL_ALIKE = torch.full((3, 500), 1 / 500, dtype=torch.float64)
"""Weights."""


def test_exposure_is_found_beside_outliers(generator: Generator) -> None:
    rendered = colours(generator)
    gain, bias = torch.tensor([0.8, 1.1, 0.6], dtype=torch.float64), torch.tensor([0.1, -0.05, 0.2]).double()
    measured = gain[:, None] * rendered[0] + bias[:, None]
    measured[:, :50] = 1.0  # outliers
    found = robust_exposure(rendered, measured, ALL_ALIKE, Robust("geman-mcclure", 0.05))
    assert float((found.gain - gain).abs().max()) < 0.12  # the prior about a gain of 1 has some weight
    assert float((found.applied(rendered)[0] - measured)[:, 50:].abs().mean()) < 0.03
    grey = torch.full((1, 3, 500), 0.5, dtype=torch.float64)
    plain = robust_exposure(grey, measured, ALL_ALIKE, Robust("huber", 0.1))
    assert bool(plain.gain.isfinite().all())


def test_clipped_colours_do_not_bend_the_exposure(generator: Generator) -> None:
    """Half of the colours are clipped at white by a gain of 2; a fit to all of them would find far less."""
    rendered = colours(generator)
    measured = (2 * rendered[0]).clamp(max=1)
    found = robust_exposure(rendered, measured, ALL_ALIKE, Robust("huber", 0.1))
    assert float((found.gain - 2).abs().max()) < 0.1
    beyond = clipped(found.applied(rendered), measured)
    assert float(beyond.double().mean()) == pytest.approx(0.5, abs=0.1)


def test_white_that_is_white_determines_the_exposure() -> None:
    """A white background keeps white what an object, of which little is seen, would make grey if it alone counted."""
    rendered = torch.ones((1, 3, 500), dtype=torch.float64)
    rendered[..., :50] = torch.linspace(0.3, 0.7, 50, dtype=torch.float64)
    measured = rendered[0].clone()
    measured[:, :50] = 0.5 * rendered[0, :, :50] + 0.2
    found = robust_exposure(rendered, measured, ALL_ALIKE, Robust("huber", 0.1))
    white = found.gain + found.bias
    assert float((white - 1).abs().max()) < 0.05
    object_alone = torch.cat([torch.ones(50), torch.zeros(450)]).expand(3, 500).double()
    alone = robust_exposure(rendered, measured, object_alone, Robust("huber", 0.1))
    assert float((alone.gain + alone.bias).max()) < 0.8


def test_rays_without_weight_do_not_matter(generator: Generator) -> None:
    rendered = colours(generator)
    weights = torch.ones((3, 500), dtype=torch.float64)
    weights[:, 7] = 0
    measured = 0.8 * rendered[0]
    expected = robust_exposure(rendered, measured, weights, Robust("huber", 0.1))
    rendered[0, :, 7] = torch.nan
    found = robust_exposure(rendered, measured, weights, Robust("huber", 0.1))
    torch.testing.assert_close(found.gain, expected.gain)


T = SE3.identity(dtype=torch.float64)
RGB = baked.toy().surfels.rgb


def brought(rgb: torch.Tensor) -> PointCloud:
    """Return every surfel, measured with colours ``rgb`` from the origin, with the map's exposure."""
    cloud = baked.points(baked.toy().surfels.positions, rgb)
    return cloud_with_exposure_of_map(SurfaceCost(baked.toy(), cloud, PointScales(0.1)), T)


@pytest.mark.parametrize("gain", [0.5, 1.0, 1.4])
def test_the_exposure_is_taken_back(gain: float) -> None:
    measured = (gain * RGB).clamp(max=1)
    found = brought(measured)
    kept = found.coloured
    assert float(kept.double().mean()) > 0.5
    assert float((found.rgb - RGB)[kept].abs().mean()) < 0.02
    assert (gain == 1) or float((measured - RGB).abs().mean()) > 0.05


def test_points_that_were_clipped_have_no_colour() -> None:
    measured = 1.4 * RGB
    clipped = (measured > 1.1).any(-1)
    assert bool(clipped.any())
    assert not bool(brought(measured.clamp(max=1)).coloured[clipped].any())
    assert bool(brought(RGB).coloured.all()), "white things are not clipped without a gain"


@pytest.mark.parametrize("channels", [slice(0, 3), slice(0, 1)], ids=["white", "red"])
def test_something_white_in_front_is_not_taken_for_clipped(channels: slice) -> None:
    """Half of the points show something white, or red, that the map does not have: their colours still contradict it."""
    measured = 1.15 * RGB - 0.03
    measured[::2, channels] = 1
    found = brought(measured.clamp(0, 1))
    wrong = (RGB[::2, channels] < 0.7).all(-1)
    assert float(wrong.double().mean()) > 0.2
    assert bool(found.coloured[::2][wrong].all())
    assert float((found.rgb - RGB)[::2][wrong].abs().amax(-1).min()) > 0.1


def test_colours_of_another_place_are_not_explained() -> None:
    """An exposure has six numbers: it cannot turn the colours of one place into those of another."""
    turned = RGB.roll(len(RGB) // 2, 0)
    found = brought(turned)
    before, after = (float((rgb - RGB).abs().mean()) for rgb in (turned, found.rgb))
    assert after > 0.7 * before


def test_points_without_colour_stay_as_they_are() -> None:
    cloud = baked.points(baked.toy().surfels.positions, RGB)
    cloud = replace(cloud, coloured=torch.zeros(len(cloud), dtype=torch.bool))
    found = cloud_with_exposure_of_map(SurfaceCost(baked.toy(), cloud, PointScales(0.1)), T)
    torch.testing.assert_close(found.rgb, cloud.rgb)
    assert not bool(found.coloured.any())


@pytest.mark.parametrize(
    "measured",
    [
        RGB / (2 * STRONGEST) + 0.02,
        torch.cat([torch.ones_like(RGB[:, :1]), 0.6 * RGB[:, 1:]], -1),
        0.95 * RGB + 0.05 * RGB.mean(0),
        torch.ones_like(RGB),
    ],
    ids=[
        "a gain of more than two stops",
        "a channel clipped everywhere",
        "the low contrast of blur",
        "white",
    ],
)
def test_colours_that_no_exposure_explains_stay(measured: torch.Tensor) -> None:
    torch.testing.assert_close(brought(measured).rgb, measured)
