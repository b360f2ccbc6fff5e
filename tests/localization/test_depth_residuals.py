"""Depth residuals at silhouettes, where a part of a ray's weight lies far behind what was measured."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core.fields import (
    Observations,
    RaySamples,
    Rendering,
    depth_residual,
    first_surface_residual,
    truncated_depth_residual,
)
from bidnerf_core.localization import ColourSettings, DepthSettings, objective_of


def pixel_at(distance: float) -> Observations:
    """Return a ray of the colour that is rendered, with a distance (metres; 0: none)."""
    zero = torch.zeros((1, 3), dtype=torch.float64)
    far = torch.full((1,), distance, dtype=torch.float64)
    return Observations(zero, zero, zero, far, torch.ones(1, dtype=torch.bool))


def silhouette(share: float, distance: float = 2.0, behind: float = 6.0) -> Rendering:
    """Return a rendering of one ray with ``share`` of its weight at ``distance``, and the rest far behind; metres."""
    middles = torch.tensor([[distance, behind]], dtype=torch.float64)
    weights = torch.tensor([[share, 1 - share]], dtype=torch.float64)
    samples = RaySamples(middles, middles, torch.ones(1, 2, dtype=torch.bool))
    return Rendering(
        torch.zeros((1, 3), dtype=torch.float64),
        (weights * middles).sum(-1),
        weights.sum(-1),
        weights,
        samples,
    )


def test_a_truncated_depth_error_bears_a_silhouette() -> None:
    """A tenth of the weight four metres behind: the mean distance is off by 0.4 m, the truncated one by a tenth of the limit."""
    pixel = pixel_at(2.0)
    rendering = silhouette(0.9)
    assert float(depth_residual(rendering, pixel)) == pytest.approx(0.4)
    assert float(truncated_depth_residual(rendering, pixel, 0.3)) == pytest.approx(0.03)
    passing = replace(rendering, weights=rendering.weights * 0, opacity=rendering.opacity * 0)
    assert float(truncated_depth_residual(passing, pixel, 0.3)) == pytest.approx(0.3)
    near = silhouette(1.0, 2.05)
    assert float(truncated_depth_residual(near, pixel, 0.3)) == pytest.approx(0.05)


def test_the_first_surface_is_compared_where_there_is_one() -> None:
    pixel = pixel_at(2.0)
    assert float(first_surface_residual(silhouette(0.9, 2.05), pixel)) == pytest.approx(0.05)
    assert float(first_surface_residual(silhouette(0.2), pixel)) == pytest.approx(
        4.0
    )  # the first one is glass
    empty = replace(silhouette(0.9), opacity=torch.zeros(1, dtype=torch.float64))
    assert float(first_surface_residual(empty, pixel)) == 0
    leaf = torch.tensor([[2.05, 6.0]], dtype=torch.float64).requires_grad_()
    samples = RaySamples(leaf, leaf, torch.ones(1, 2, dtype=torch.bool))
    rendering = replace(silhouette(0.9, 2.05), samples=samples)
    (slope,) = torch.autograd.grad(first_surface_residual(rendering, pixel).sum(), leaf)
    torch.testing.assert_close(slope, torch.tensor([[1.0, 0.0]], dtype=torch.float64))


def test_light_that_passes_through_matter_is_penalised() -> None:
    term = objective_of(ColourSettings("l2"), DepthSettings(0.0, "l2", opacity_weight=2.0))
    pixels, half = pixel_at(2.0), replace(silhouette(0.9), opacity=torch.full((1,), 0.5, dtype=torch.float64))
    assert term.uses_depth
    assert float(term.loss(half, pixels)) == pytest.approx(2.0 * 0.5 * 0.5**2)
    assert float(term.loss(half, pixel_at(0.0))) == 0
