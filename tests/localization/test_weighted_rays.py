"""Drawn rays with their weights: those of the objective, rays of depth beside pixels, and blurred colours."""

from __future__ import annotations

import pytest
import torch
from torch import Generator

from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import ColourSettings, DepthSettings, RayCounts, objective_of, rig
from bidnerf_core.localization.costs.rendered import blurred, draw_weighted_rays
from blob_images import BOUNDS, CAMERA, FIELD, FRAME, POSES, TRUTH, photograph
from problems import FieldMap, single
from tiny import depth_rays_of


@pytest.mark.parametrize("size", [2, 3, 7, 100])
def test_blur_keeps_means_and_places(size: int) -> None:
    """An image that changes evenly stays what it is, away from its borders."""
    u, v = CAMERA.pixel_centres().unbind(-1)
    even = Frame("even", torch.stack([u / 48, v / 40, torch.full_like(u, 0.3)], -1), CAMERA)
    smooth = blurred(View(even, TRUTH), size).frame.rgb
    assert smooth.shape == even.rgb.shape
    torch.testing.assert_close(smooth[..., 2], even.rgb[..., 2])
    inner = smooth[size : -2 * size, size : -2 * size] - even.rgb[size : -2 * size, size : -2 * size]
    assert inner.numel() == 0 or float(inner.abs().max()) < 1e-5


def test_weights_of_each_kind_of_measurement_add_up_to_its_weight_in_the_objective() -> None:
    """Colours of all pixels and each channel to 1, depths of each sensor to lambda_d."""
    views = [View(photograph(T), T) for T in POSES]
    objective = objective_of(ColourSettings(), DepthSettings(depth_weight=3.0))
    problem = rig(FieldMap(FIELD, BOUNDS), views, None)
    drawn = draw_weighted_rays(problem, objective, RayCounts(90), "uniform", 1, Generator().manual_seed(0))
    torch.testing.assert_close(drawn.weights.sum(0), torch.tensor([1.0, 1.0, 1.0, 3.0]))
    assert not bool(drawn.weights[~drawn.observed.measured][:, 3].any())


def test_rays_of_depth_join_pixels_unless_depth_has_no_weight() -> None:
    lidar = depth_rays_of([View(FRAME, SE3.identity())])
    problem = single(FIELD, BOUNDS, photograph(depth=False), TRUTH, lidar)
    for weight, count, expected in ((2.0, 40, 90), (2.0, 0, 50), (0.0, 40, 50)):
        objective = objective_of(ColourSettings(), DepthSettings(depth_weight=weight))
        drawn = draw_weighted_rays(
            problem, objective, RayCounts(50, count), "uniform", 1, Generator().manual_seed(0)
        )
        assert len(drawn.observed) == len(drawn.weights) == expected
        assert not bool(drawn.weights[50:, :3].any())
        torch.testing.assert_close(
            drawn.weights[50:, 3:].sum(), torch.tensor(weight if count and weight else 0.0)
        )
