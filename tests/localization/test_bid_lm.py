"""Method ``bid-lm`` on a closed-form scene: where it leads, how certain it is, and what it rejects."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import perturb
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import rig, settings_of
from bidnerf_core.results import pose_error
from blob_images import BOUNDS, CAMERA, FIELD, FRAME, POSES, TRUTH, photograph
from problems import FieldMap, localize, single
from tiny import depth_rays_of

FEW = {
    "poses": 8, "search_rays": 64, "coarse_poses": 3, "coarse_rays": 64, "middle_rays": 128, "fine_rays": 512, "blur": 2,
}  # fmt: skip


def test_it_comes_to_the_truth_in_few_steps() -> None:
    start = perturb(TRUTH, 0.4, 10.0, seed=1)
    found = localize(single(FIELD, BOUNDS, FRAME, start), "bid-lm", FEW)
    after = pose_error(found.T_world_camera, TRUTH)
    assert float(after.translation) < 0.03
    assert float(after.rotation_deg) < 0.4
    assert found.converged, found.reason
    assert found.method == "bid-lm"
    assert found.steps < 20
    assert found.poses.translation.shape == (found.steps + 1, 3)
    assert len(found.losses) == found.steps
    assert torch.equal(found.poses[0].matrix(), start.matrix())
    assert torch.equal(found.poses[-1].matrix(), found.T_world_camera.matrix())


def test_bid_needs_many_more() -> None:
    """Adam starts at the same pose and takes as many steps as the second-order method took at most."""
    problem = single(FIELD, BOUNDS, FRAME, perturb(TRUTH, 0.4, 10.0, seed=1))
    first = localize(problem, "bid", {"rays": 256, "max_steps": 20})
    second = localize(problem, "bid-lm", FEW)
    one, other = (float(pose_error(x.T_world_camera, TRUTH).translation) for x in (first, second))
    assert other < 0.1 * one


def test_the_same_seed_gives_the_same_answer() -> None:
    problem = single(FIELD, BOUNDS, FRAME, perturb(TRUTH, 0.2, 5.0, seed=3))
    one, same, other = (localize(problem, "bid-lm", FEW, seed) for seed in (4, 4, 5))
    assert torch.equal(one.poses.matrix(), same.poses.matrix())
    assert not torch.equal(one.T_world_camera.matrix(), other.T_world_camera.matrix())


def test_a_rig_and_a_lidar() -> None:
    views = [View(photograph(T), T) for T in POSES]
    start = perturb(POSES[2], 0.3, 6.0, seed=4)
    together = localize(rig(FieldMap(FIELD, BOUNDS), views, start), "bid-lm", FEW)
    assert float(pose_error(together.T_world_camera, POSES[2]).translation) < 0.03

    blind = single(FIELD, BOUNDS, replace(FRAME, depth=None), perturb(TRUTH, 0.2, 5.0, seed=5))
    lidar = depth_rays_of([View(FRAME, SE3.identity())])
    found = localize(replace(blind, depth_rays=lidar), "bid-lm", FEW)
    assert float(pose_error(found.T_world_camera, TRUTH).translation) < 0.03


def test_an_image_of_another_exposure() -> None:
    darker = replace(FRAME, rgb=0.6 * FRAME.rgb + 0.15)
    problem = single(FIELD, BOUNDS, darker, perturb(TRUTH, 0.2, 5.0, seed=6))
    found = localize(problem, "bid-lm", {**FEW, "exposure": True})
    assert float(pose_error(found.T_world_camera, TRUTH).translation) < 0.03
    assert found.converged, found.reason
    assert not localize(problem, "bid-lm", FEW).converged


def test_it_does_not_claim_what_it_cannot_know() -> None:
    blank = Frame("blank", torch.ones((40, 48, 3)), CAMERA)
    found = localize(single(FIELD, BOUNDS, blank, perturb(TRUTH, 0.3, 5.0, seed=0)), "bid-lm", FEW)
    assert not found.converged
    away = TRUTH.retract(torch.tensor([0, 0, 0, 3.1, 0, 0], dtype=torch.float64))
    lost = localize(single(FIELD, BOUNDS, blank, away), "bid-lm", {**FEW, "poses": 1})
    assert not lost.converged
    assert lost.covariance is None
    assert "determine" in lost.reason


def test_a_window_about_the_measured_depth_serves_as_well() -> None:
    problem = single(FIELD, BOUNDS, FRAME, perturb(TRUTH, 0.2, 5.0, seed=7))
    found = localize(problem, "bid-lm", {**FEW, "depth_window": 0.5, "window_samples": 24})
    assert float(pose_error(found.T_world_camera, TRUTH).translation) < 0.03


@pytest.mark.parametrize(
    ("setting", "value"),
    [("poses", 0), ("fine_rays", 6), ("coarse_steps", 0), ("blur", 0), ("colour_scale", 0.0),
     ("least_weight", 1.0), ("surface_sigma", -1.0), ("stop_step", -1e-9), ("depth_scale", 0.0), ("depth_window", -0.1),
     ("centring", -1), ("window_samples", 0), ("depth_rays", -1)],
)  # fmt: skip
def test_settings_that_make_no_sense_are_named(setting: str, value: object) -> None:
    with pytest.raises(InputError, match=f"{setting} is .*, expected "):
        settings_of("bid-lm", {setting: value})
