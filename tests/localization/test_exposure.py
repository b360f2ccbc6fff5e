"""Exposure: weighted least squares with priors, against numpy, and under outliers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Generator, Tensor

from bidnerf_core.geometry import Robust
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
