"""Every method on a closed-form scene: where it leads from a start, how it tells of its way, what it uses, and what it rejects."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch

from bidnerf import SE3, Frame, Localization, Localizer, Outcome, View
from bidnerf.results import pose_error
from bidnerf.scenes import orbit
from bidnerf_core.geometry import perturb
from bidnerf_core.localization import METHODS, settings_of
from bidnerf_core.mapping import BakeConfig, bake
from blob_images import BOUNDS, CAMERA, FIELD, FRAME, POSES, TRUTH, photograph
from problems import FieldMap
from refusals import refused
from tiny import depth_rays_of

FEW: dict[str, dict[str, Any]] = {
    "auto": {"points": 800, "hypotheses": 24, "rounds": 1, "refine_steps": 2, "fine_rays": 128},
    "bid": {
        "rays": 256,
        "max_steps": 60,
        "learning_rate": 0.08,
        "decay": 0.5,
        "decay_steps": 20,
        "depth_weight": 0.3,
        "level": None,
    },
    "inerf": {"rays": 128, "max_steps": 60, "learning_rate": 0.04, "decay": 0.5, "decay_steps": 20},
}
"""Settings for small images, by method."""
FEWEST: dict[str, dict[str, Any]] = {
    "auto": {"points": 200, "hypotheses": 8},
    "bid": {"rays": 64, "max_steps": 3},
    "inerf": {"rays": 64, "max_steps": 3},
}
"""Settings of these that differ where the pose does not matter."""
REMAINING = {"auto": 0.25, "bid": 0.35, "inerf": 0.4}
"""Largest error after the descent, as a share of the error of the start."""


@functools.cache
def scene(surface: bool = False) -> FieldMap:
    seen = [(replace(CAMERA, fx=60.0, fy=60.0), T) for T in orbit(4.0, 16, elevation=(-10.0, 80.0), seed=0)]
    return FieldMap(FIELD, BOUNDS, bake(FIELD, BOUNDS, seen, config=BakeConfig(cells=100_000)) if surface else None)


def found_by(
    method: str,
    query: Any = FRAME,
    start: SE3 | None = None,
    seed: int = 0,
    lidar: Any = None,
    **changes: Any,
) -> Localization:
    config = settings_of(method, FEW[method] | changes)
    localizer = Localizer(scene(surface=method == "auto"), method, config, warm_up=False)
    return localizer(query, start, lidar, seed)


@pytest.fixture
def hardly_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Judging a short descent takes longer than its steps."""
    monkeypatch.setattr("bidnerf_bid.methods.RAYS", 16)


def off(T: SE3, truth: SE3 = TRUTH) -> float:
    return float(pose_error(T, truth).translation)


def rig(depth: bool) -> list[View]:
    return [View(photograph(T, depth), T) for T in (POSES[0], POSES[2], TRUTH)]


@pytest.mark.usefixtures("hardly_judged")
@pytest.mark.parametrize(
    ("method", "depth", "count"),
    [
        pytest.param(
            method,
            rig and METHODS[method].uses_depth,
            3 if rig else 1,
            id=f"{method}-{'rig' if rig else 'one'}",
        )
        for method in METHODS
        for rig in (False, True)
    ],
)
def test_a_descent_from_a_start_leads_to_the_truth_and_tells_its_way(method: str, depth: bool, count: int) -> None:
    start = perturb(TRUTH, 0.15, 4.0, seed=2)
    query = photograph(depth=depth) if count == 1 else rig(depth)
    if method == "inerf" and count > 1:
        with refused(found="method inerf takes one image, got 3"):
            found_by(method, query, start)
        return
    found = found_by(method, query, start)
    assert off(found.T_world_camera) < REMAINING[method] * off(start)
    assert found.method == method
    assert found.T_world_camera.rotation.dtype == torch.float64
    assert not found.T_world_camera.rotation.requires_grad
    assert found.steps == len(found.losses) == len(found.poses.translation) - 1
    torch.testing.assert_close(found.poses[-1].matrix(), found.T_world_camera.matrix())
    if method != "auto":  # which begins at the best of several poses
        assert torch.equal(found.poses[0].matrix(), start.matrix())
    if found.covariance is not None:
        torch.testing.assert_close(found.covariance, found.covariance.mT, rtol=1e-6, atol=0)
        assert float(torch.linalg.eigvalsh(found.covariance)[0]) > 0


@pytest.mark.usefixtures("hardly_judged")
@pytest.mark.parametrize("method", METHODS)
def test_all_random_choices_come_from_the_seed(method: str) -> None:
    start, poses = perturb(TRUTH, 0.1, 3.0, seed=3), []
    for seed in (4, 4, 5):
        torch.manual_seed(len(poses))
        poses.append(found_by(method, start=start, seed=seed, **FEWEST[method]))
    one, same, other = (found.poses.matrix() for found in poses)
    assert torch.equal(one, same)
    assert not torch.equal(one[-1], other[-1])


@pytest.mark.usefixtures("hardly_judged")
def test_a_method_of_colour_alone_uses_no_depth() -> None:
    method = "inerf"
    start, wrong = perturb(TRUTH, 0.1, 3.0, seed=2), replace(FRAME, depth=torch.full((40, 48), 9.0))
    one, other = (found_by(method, f, start, **FEWEST[method]) for f in (photograph(depth=False), wrong))
    assert torch.equal(one.poses.matrix(), other.poses.matrix())
    with refused(found=f"method '{method}' uses colour alone, got depth points"):
        found_by(method, start=start, lidar=depth_rays_of([View(FRAME, SE3.identity())]))


@pytest.mark.usefixtures("hardly_judged")
def test_the_rays_of_a_lidar_stand_in_for_depth() -> None:
    start, lidar = perturb(TRUTH, 0.15, 4.0, seed=5), depth_rays_of([View(FRAME, SE3.identity())])
    found = found_by("bid", photograph(depth=False), start, lidar=lidar, depth_rays=128)
    assert off(found.T_world_camera) < REMAINING["bid"] * off(start)


@pytest.mark.parametrize("method", METHODS)
def test_a_blank_image_does_not_determine_a_pose(method: str) -> None:
    """The loss of a plain background is 0 wherever no ray meets anything."""
    blank = Frame("blank", torch.ones((40, 48, 3)), CAMERA)
    few = FEWEST[method]
    assert not found_by(method, blank, perturb(TRUTH, 0.3, 5.0, seed=0), **few).converged
    away = found_by(method, blank, TRUTH.retract(torch.tensor([0, 0, 0, 3.1, 0, 0]).double()), **few)
    assert away.outcome is Outcome.UNDETERMINED, away.reason
