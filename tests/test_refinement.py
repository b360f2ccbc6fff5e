"""Second-order methods on closed-form scenes: where they come to, how sure they are, and what they say of it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Generator

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.field import SceneBounds
from bidnerf_core.frames import Frame, View
from bidnerf_core.localization import BidConfig, BidLmConfig, InerfLmConfig, localize, rig, single
from bidnerf_core.localization.neighbours import neighbours
from bidnerf_core.localization.photometric import refine, stepped
from bidnerf_core.localization.ray_batch import blurred
from bidnerf_core.localization.pivots import PivotName
from bidnerf_core.localization.stages import Refinement, Stage
from bidnerf_core.pixels import depth_rays_of
from bidnerf_core.rendering import render
from bidnerf_core.scenes.fields import GaussianBlobs
from bidnerf_core.scenes.trajectories import orbit
from bidnerf_core.se3 import SE3

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.1, 12.0, (1.0, 1.0, 1.0))
CAMERA = Intrinsics(50.0, 50.0, 24.0, 20.0, 48, 40)
POSES = orbit(4.0, 3, seed=1)
TRUTH = POSES[1]
FIELD = GaussianBlobs.random(density=60.0)
FEW = BidLmConfig(
    poses=8, search_rays=64, coarse_poses=3, coarse_rays=64, middle_rays=128, fine_rays=512, blur=2
)


def photograph(T: SE3 = TRUTH, depth: bool = True) -> Frame:
    """What a perfect RGB-D camera sees: the rendering's own colour and, where it is opaque, distance."""
    ray = CAMERA.unproject(CAMERA.pixel_centres(torch.float64))
    length = torch.linalg.vector_norm(ray, dim=-1)
    directions = T.rotate(ray / length[..., None])
    seen = render(FIELD, BOUNDS.rays(T.translation.expand_as(directions), directions), BOUNDS.background)
    opaque = seen.opacity > 0.95
    measured = torch.where(opaque, seen.distance / seen.opacity.clamp(min=0.9) / length, 0)
    return Frame("frame", seen.rgb.float(), CAMERA, measured.float() if depth else None)


FRAME = photograph()


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
    """From the same start, with as many steps as the second-order method took at the most."""
    problem = single(FIELD, BOUNDS, FRAME, perturb(TRUTH, 0.4, 10.0, seed=1))
    first = localize(problem, "bid", BidConfig(rays=256, max_steps=20))
    second = localize(problem, "bid-lm", FEW)
    one, other = (float(pose_error(x.T_world_camera, TRUTH).translation) for x in (first, second))
    assert other < 0.1 * one


def test_colour_alone_finds_a_place_that_is_near() -> None:
    start = perturb(TRUTH, 0.1, 3.0, seed=2)
    config = InerfLmConfig(poses=8, search_poses=2, middle_poses=2, coarse_rays=128, fine_rays=512)
    answers = [
        localize(single(FIELD, BOUNDS, frame, start), "inerf-lm", config)
        for frame in (FRAME, replace(FRAME, depth=None), replace(FRAME, depth=torch.full((40, 48), 9.0)))
    ]
    assert float(pose_error(answers[0].T_world_camera, TRUTH).translation) < 0.03
    for other in answers[1:]:  # depth is not looked at
        assert torch.equal(other.T_world_camera.matrix(), answers[0].T_world_camera.matrix())


def test_colour_alone_finds_a_place_that_is_far() -> None:
    """A camera that was turned by 30 degrees sees next to nothing of what it saw."""
    start = TRUTH @ SE3.exp(torch.tensor([0.1, -0.1, 0.1, 0.0, 0.5, 0.1], dtype=torch.float64))
    blind = single(FIELD, BOUNDS, replace(FRAME, depth=None), start)
    found = localize(
        blind,
        "inerf-lm",
        InerfLmConfig(poses=96, search_poses=8, middle_poses=3, coarse_rays=128, fine_rays=512),
    )
    assert float(pose_error(found.T_world_camera, TRUTH).translation) < 0.03
    assert found.converged, found.reason
    assert found.steps == len(found.losses) == len(found.poses.translation) - 1
    assert torch.equal(found.poses[0].matrix(), start.matrix())


def test_the_same_seed_gives_the_same_answer() -> None:
    problem = single(FIELD, BOUNDS, FRAME, perturb(TRUTH, 0.2, 5.0, seed=3))
    one, same, other = (localize(problem, "bid-lm", FEW, seed) for seed in (4, 4, 5))
    assert torch.equal(one.poses.matrix(), same.poses.matrix())
    assert not torch.equal(one.T_world_camera.matrix(), other.T_world_camera.matrix())


def test_a_rig_and_a_lidar() -> None:
    views = [View(photograph(T), T) for T in POSES]
    start = perturb(POSES[2], 0.3, 6.0, seed=4)
    together = localize(rig(FIELD, BOUNDS, views, start), "bid-lm", FEW)
    assert float(pose_error(together.T_world_camera, POSES[2]).translation) < 0.03

    blind = single(FIELD, BOUNDS, replace(FRAME, depth=None), perturb(TRUTH, 0.2, 5.0, seed=5))
    lidar = depth_rays_of([View(FRAME, SE3.identity())])
    found = localize(replace(blind, depth_rays=lidar), "bid-lm", FEW)
    assert float(pose_error(found.T_world_camera, TRUTH).translation) < 0.03


def test_an_image_of_another_exposure() -> None:
    darker = replace(FRAME, rgb=0.6 * FRAME.rgb + 0.15)
    problem = single(FIELD, BOUNDS, darker, perturb(TRUTH, 0.2, 5.0, seed=6))
    found = localize(problem, "bid-lm", replace(FEW, exposure=True))
    assert float(pose_error(found.T_world_camera, TRUTH).translation) < 0.03
    assert found.converged, found.reason
    assert not localize(problem, "bid-lm", FEW).converged


def test_it_does_not_claim_what_it_cannot_know() -> None:
    blank = Frame("blank", torch.ones((40, 48, 3)), CAMERA)
    found = localize(single(FIELD, BOUNDS, blank, perturb(TRUTH, 0.3, 5.0, seed=0)), "bid-lm", FEW)
    assert not found.converged
    away = TRUTH.retract(torch.tensor([0, 0, 0, 3.1, 0, 0], dtype=torch.float64))
    lost = localize(single(FIELD, BOUNDS, blank, away), "bid-lm", replace(FEW, poses=1))
    assert not lost.converged
    assert lost.covariance is None
    assert "determine" in lost.reason


def test_a_window_about_the_measured_depth_serves_as_well() -> None:
    problem = single(FIELD, BOUNDS, FRAME, perturb(TRUTH, 0.2, 5.0, seed=7))
    found = localize(problem, "bid-lm", replace(FEW, depth_window=0.5, window_samples=24))
    assert float(pose_error(found.T_world_camera, TRUTH).translation) < 0.03


def test_the_covariance_is_that_of_many_trials() -> None:
    """Noise of known size on colour and depth: squared errors in units of the covariance average to 6."""
    settings, stage = Refinement(least_weight=0), Stage(3, 128, level=None, colour_scale=0.5)
    at = SE3(TRUTH.rotation[None], TRUTH.translation[None])
    squared, trials = [], 30
    for seed in range(trials):
        generator = torch.Generator().manual_seed(seed)
        colour = FRAME.rgb + 0.02 * torch.randn(FRAME.rgb.shape, generator=generator)
        assert FRAME.depth is not None
        depth = FRAME.depth + 0.01 * (FRAME.depth > 0) * torch.randn(FRAME.depth.shape, generator=generator)
        problem = single(FIELD, BOUNDS, replace(FRAME, rgb=colour, depth=depth), TRUTH)
        found = refine(problem, at, (stage,), settings, generator)
        xi = (found.T.inverse() @ TRUTH).log()
        squared.append(float(xi @ torch.linalg.solve(found.covariance, xi)))
    # The mean of n chi-square variables with 6 degrees of freedom varies by sqrt(12 / n).
    assert sum(squared) / trials == pytest.approx(6, abs=4 * (12 / trials) ** 0.5)


def test_the_covariance_is_the_cameras_whatever_the_pivot() -> None:
    problem = single(FIELD, BOUNDS, FRAME, TRUTH)
    at = SE3(TRUTH.rotation[None], TRUTH.translation[None])
    names: tuple[PivotName, ...] = ("camera", "scene", "world")
    found = [
        refine(problem, at, (Stage(8, 256),), Refinement(pivot=name), torch.Generator().manual_seed(0))
        for name in names
    ]
    for other in found[1:]:
        torch.testing.assert_close(other.T.matrix(), found[0].T.matrix(), rtol=0, atol=1e-3)
        torch.testing.assert_close(
            other.covariance.diagonal(), found[0].covariance.diagonal(), rtol=0.1, atol=0
        )


def test_the_cloud_is_even_and_holds_the_start() -> None:
    poses = neighbours(TRUTH, 512, 0.2, 0.1, seed=0)
    xi = (SE3(TRUTH.rotation[None], TRUTH.translation[None]).inverse() @ poses).log()
    assert float(xi[0].abs().max()) < 1e-9
    expected = torch.tensor([0.2] * 3 + [0.1] * 3, dtype=torch.float64)
    torch.testing.assert_close(xi.std(0), expected, rtol=0.1, atol=0)
    assert float(xi.mean(0).abs().max()) < 0.01
    assert neighbours(TRUTH, 1, 0.2, 0.1, seed=0).translation.shape == (1, 3)


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


@pytest.mark.parametrize(
    ("setting", "value"),
    [("poses", 0), ("fine_rays", 6), ("coarse_steps", 0), ("blur", 0), ("colour_scale", 0.0),
     ("least_weight", 1.0), ("play", -1.0), ("stop_step", float("nan")), ("depth_scale", 0.0), ("depth_window", -0.1),
     ("centring", -1), ("window_samples", 0), ("depth_rays", -1)],
)  # fmt: skip
def test_settings_that_make_no_sense_are_named(setting: str, value: object) -> None:
    with pytest.raises(InputError, match=f"{setting} is .*, expected "):
        replace(BidLmConfig(), **{setting: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("setting", "value"),
    [("poses", 0), ("search_poses", 0), ("middle_steps", 0), ("width", 3), ("spread_rotation", -1.0), ("fine_rays", 6),
     ("coarse_steps", 0), ("colour_scale", 0.0), ("least_weight", 1.0), ("play", -1.0)],
)  # fmt: skip
def test_so_are_those_of_colour_alone(setting: str, value: object) -> None:
    with pytest.raises(InputError, match=f"{setting} is .*, expected "):
        replace(InerfLmConfig(), **{setting: value})  # type: ignore[arg-type]


def test_a_few_steps_alone_are_those_of_a_refinement() -> None:
    problem, near = single(FIELD, BOUNDS, FRAME, None), perturb(TRUTH, 0.05, 1.0, seed=2)
    stage, settings = Stage(3, 512), Refinement()
    steps = stepped(problem, near, stage, settings, Generator().manual_seed(0))
    poses = steps.poses
    assert steps.inliers > 0.95
    whole = refine(problem, near[None], (stage,), settings, Generator().manual_seed(0))
    assert torch.allclose(poses.matrix(), whole.poses.matrix(), atol=1e-3)
    errors = pose_error(poses, TRUTH).translation
    assert float(errors[-1]) < 0.3 * float(errors[0])


def test_at_the_truth_no_step_leads_away() -> None:
    stage, settings = Stage(3, 256), Refinement(depth_weight=0.0)
    steps = stepped(single(FIELD, BOUNDS, FRAME, None), TRUTH, stage, settings, Generator().manual_seed(0))
    assert float(pose_error(steps.poses, TRUTH).translation.max()) < 1e-3
