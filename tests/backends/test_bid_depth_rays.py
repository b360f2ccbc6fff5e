"""Depth that no pixel measured, in the loss and in the answers of ``bid``."""

from __future__ import annotations

from dataclasses import replace

import torch

from bidnerf_bid import DepthSettings, DescentSettings, ReachSettings, SampledLoss, objective_of
from bidnerf_core.geometry import SE3, perturb
from bidnerf_core.localization import ColourSettings, Problem
from blob_images import BOUNDS, FIELD, FRAME, TRUTH, lidar, photograph
from problems import localize, single

OBJECTIVE = objective_of(ColourSettings(), DepthSettings(depth_scale=0.1))


def depth_loss(problem: Problem, T: SE3, count: int = 10**6) -> float:
    """The part of the loss that the depth rays add."""
    values = []
    for own in (count, 0):
        generator = torch.Generator().manual_seed(0)
        loss = SampledLoss(problem, OBJECTIVE, own, DescentSettings(rays=16), ReachSettings(), generator)
        values.append(float(loss(T)))
    return values[0] - values[1]


def test_no_residual_at_the_truth_and_some_elsewhere() -> None:
    problem = single(FIELD, BOUNDS, photograph(depth=False), TRUTH, lidar())
    assert abs(depth_loss(problem, TRUTH)) < 1e-8
    assert depth_loss(problem, perturb(TRUTH, 0.2, 5.0, seed=0)) > 1e-4


def test_a_lidar_alone_tells_how_far_the_scene_is() -> None:
    """All black to the eye: no pixel has a gradient that is of use, but the distance comes right."""
    dark = replace(FRAME, rgb=torch.zeros(40, 48, 3), depth=None)
    start = TRUTH.retract(torch.tensor([0, 0, -0.2, 0, 0, 0], dtype=torch.float64))
    config = {
        "rays": 1,
        "depth_rays": 200,
        "max_steps": 60,
        "learning_rate": 0.03,
        "level": None,
        "depth_weight": 1e3,
        "pivot": "camera",
    }
    found = localize(single(FIELD, BOUNDS, dark, start, lidar()), "bid", config)
    backward = TRUTH.inverse().apply(found.T_world_camera.translation)[2]
    assert abs(float(backward)) < 0.03


def test_weight_zero_leaves_depth_rays_out() -> None:
    start = perturb(TRUTH, 0.3, 6.0, seed=3)
    few = {"rays": 32, "max_steps": 3, "depth_weight": 0.0, "level": None, "pivot": "camera"}
    with_rays, without = (
        localize(single(FIELD, BOUNDS, photograph(depth=False), start, rays), "bid", few) for rays in (lidar(), None)
    )
    assert torch.equal(with_rays.poses.matrix(), without.poses.matrix())
