"""Ways to measure a frame beside followed landmarks: colour alone, depth alone, depth beside landmarks, and odometry.

Odometry, flow and the fusion with depth are needed here for oracles: the true motion, noise, and a general solver.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bidnerf_core import SE3, Frame, Localizer, Outcome, Tracker
from bidnerf_core.geometry import USUAL
from bidnerf_core.localization import (
    AutoConfig,
    GaussianPrior,
    PointScales,
    Scaled,
    Sum,
    SurfaceCost,
    descend,
)

# Inside: odometry, flow and fusion, each against its own oracle
from bidnerf_core.localization.covariance import FINEST
from bidnerf_core.localization.tracking.flow import alike
from bidnerf_core.localization.tracking.measuring import followed
from bidnerf_core.localization.tracking.motion import Motion, PoseEstimate
from bidnerf_core.localization.tracking.points import FollowedPoints
from bidnerf_core.localization.tracking.recognition import LEAST_CORNERS, Odometry
from bidnerf_core.localization.tracking.state import CorrectedCamera, TrackerState
from bidnerf_core.localization.tracking.surface import (
    fused_with_surface,
    measured_cloud,
)
from bidnerf_core.mapping import grey_image
from bidnerf_core.results import pose_error
from bidnerf_core.testing import CAMERA, textured_map
from flights import (
    INTERVAL,
    assert_honest,
    assert_right,
    flight,
    flight_pose,
    localizer,
    tracked,
    without_depth,
)
from localizations import assert_covered, assert_near

NEAR = torch.tensor([0.01, -0.01, 0.01, 0.01, 0.01, -0.02], dtype=torch.float64)


def covariance(translation: float, rotation: float) -> torch.Tensor:
    return torch.diag(torch.tensor([translation] * 3 + [rotation] * 3, dtype=torch.float64) ** 2)


def at(T: SE3) -> Motion:
    """Return a camera at ``T``, known to a millimetre, that is about a metre from what it sees."""
    return Motion.at(PoseEstimate(T, covariance(1e-3, 1e-3), covariance(1e-3, 1e-3)), 1.5)


def depth_only(frame: Frame) -> Frame:
    return replace(frame, rgb=torch.zeros_like(frame.rgb), has_colour=False)


def test_an_image_without_depth_is_tracked_by_colour_in_a_map_without_landmarks() -> None:
    bare = replace(textured_map(), landmarks=None)
    start = flight_pose(0).retract(NEAR)
    frames = [(t, without_depth(frame), T) for t, frame, T in flight()[:1]]
    tracker = Tracker(Localizer(bare, config=AutoConfig(landmarks=False)), start=start)
    answers = tracked(frames, tracker)
    assert_right(answers, frames)
    assert float(pose_error(answers[0].T_world_camera, flight_pose(0)).translation) < 0.01


def test_frames_without_colours_are_tracked_between_photos() -> None:
    """The ground determines the height and the tilts; where the rest is known well enough, a pose is accepted."""
    frames = [(t, depth_only(f) if n % 3 else f, T) for n, (t, f, T) in enumerate(flight()[:10])]
    answers = tracked(frames, Tracker(localizer()))
    assert_right(answers[slice(0, None, 3)], frames[slice(0, None, 3)])
    assert_honest(answers, frames)
    between = [(answers[n], frames[n][2]) for n in range(10) if n % 3]
    assert sum(answer.converged for answer, _ in between) >= 2
    for answer, truth in between:
        assert "measured points lie on the surface" in answer.reason
        assert answer.outcome in (Outcome.CONVERGED, Outcome.IMPRECISE)
        assert_covered(answer.T_world_camera, truth, answer.covariance)


def test_flow_of_mere_noise_is_recognised() -> None:
    generator = np.random.default_rng(0)
    noise = [(150 + 5 * generator.standard_normal((96, 128))).astype(np.uint8) for _ in range(2)]
    place = torch.tensor([[30.5, 40.5], [60.5, 20.5], [3.5, 2.5]])
    assert not bool(alike(noise[0], noise[1], place, place).any())
    moved = np.roll(noise[0], (2, 3), (0, 1))
    assert alike(noise[0], moved, place, place + torch.tensor([3.0, 2.0])).tolist()[:2] == [True, True]


def test_shape_alone_does_not_correct_a_vague_prediction() -> None:
    """A wall would fit any other wall."""
    frames = [(t, depth_only(f) if n == 3 else f, T) for n, (t, f, T) in enumerate(flight()[:4])]
    late = [*frames[:3], (frames[3][0] + 5.0, *frames[3][1:])]
    answer = tracked(late, Tracker(localizer()))[3]
    assert answer.outcome is Outcome.UNDETERMINED
    assert "too uncertain" in answer.reason
    assert torch.equal(answer.poses.translation[0], answer.poses.translation[1])


def test_no_sequence_begins_with_a_shape_alone() -> None:
    tracker = Tracker(localizer())
    answers = tracked([(t, depth_only(f), T) for t, f, T in flight()[:2]], tracker)
    assert [answer.outcome for answer in answers] == [Outcome.TOO_FEW_MATCHES] * 2
    assert_right(tracked(flight()[2:3], tracker), flight()[2:3])


def test_a_frame_without_colours_and_depth_is_reported() -> None:
    tracker = Tracker(localizer())
    tracked(flight()[:2], tracker)
    blind = without_depth(depth_only(flight()[2][1]))
    answer = tracker(blind, flight()[2][0])
    assert answer.outcome is Outcome.TOO_FEW_MATCHES
    assert_right(tracked(flight()[3:5], tracker), flight()[3:5])


def test_odometry_finds_the_motion_between_two_frames_without_a_map() -> None:
    (_, first, T_first), (_, second, T_second) = flight()[0], flight()[1]
    odometry, before, now = Odometry(100, 0.5), grey_image(first.rgb), grey_image(second.rgb)
    corners = odometry.replenished(first, before, FollowedPoints.none(), T_first)
    state = TrackerState(Tracker(localizer())._state.clock, points=corners, image=before)
    seen = followed(state, now, second, T_first)
    moved = odometry.moved(second, seen, at(T_first), T_first, INTERVAL)
    assert moved is not None
    motion, agreeing = moved
    assert_near(motion.T_world_camera, T_second, 0.02, 0.8)
    assert len(agreeing) >= LEAST_CORNERS
    truth = (T_first.inverse() @ T_second).log() / INTERVAL
    assert torch.allclose(motion.velocity, truth, atol=0.2)
    assert float(motion.covariance.diagonal().sum()) > float(at(T_first).covariance.diagonal().sum())


def test_odometry_refuses_corners_that_contradict_each_other() -> None:
    (_, first, T_first), (_, second, _) = flight()[0], flight()[1]
    odometry = Odometry(100, 0.5)
    corners = odometry.replenished(first, grey_image(first.rgb), FollowedPoints.none(), T_first)
    order = torch.randperm(len(corners), generator=torch.Generator().manual_seed(0))
    shuffled = replace(corners, pixels=corners.pixels[order])
    assert odometry.moved(second, shuffled, at(T_first), T_first, INTERVAL) is None


@pytest.mark.parametrize("steps", [3, 6])
def test_fusing_with_depth_minimizes_the_sum_of_prior_and_surface(steps: int) -> None:
    """The general solver on both costs is the oracle; few steps suffice from a pose that is nearly right."""
    _, frame, truth = flight()[2]
    surface = textured_map(surface=True).surface
    assert surface is not None
    cloud = measured_cloud(frame, 400, 1.0, torch.Generator().manual_seed(0))
    start = PoseEstimate(truth.retract(0.3 * NEAR), covariance(0.01, 0.01), covariance(0.004, 0.004))
    fused = fused_with_surface(start, surface, cloud, steps)
    cost = SurfaceCost(surface, cloud, PointScales(FINEST * surface.cell))
    variance = float(cost.residual_variance(start.T_world_camera[None])[0])
    prior = GaussianPrior(start.T_world_camera, start.covariance, cloud.pivot)
    both = Sum((prior, Scaled(cost, USUAL.tracked_points / variance)))
    best = descend(both, start.T_world_camera[None], 20, cloud.pivot.moved).T[0]
    assert_near(fused.T_world_camera, best, 1e-3, 0.05)
    smaller = torch.linalg.eigvalsh(start.covariance - fused.covariance)
    assert float(smaller[0]) > -1e-12
    assert bool((torch.linalg.eigvalsh(fused.noise) > 0).all())
    assert bool((torch.linalg.eigvalsh(fused.bias) > 0).all())


def test_corrections_of_intrinsics_follow_one_another(tmp_path: Path) -> None:
    first = CorrectedCamera(replace(CAMERA, fx=140.0, cx=60.0), CAMERA, False)
    second = CorrectedCamera(CAMERA, replace(CAMERA, fx=133.0, cy=50.0), False)
    both = first.then(second)
    frame = replace(flight()[0][1], intrinsics=first.given)
    assert both.corrected(frame).intrinsics == second.corrected(first.corrected(frame)).intrinsics
    assert both.focal_factor(frame) == pytest.approx((133 / 140) ** 0.5)  # those down did not change
    other = replace(frame, intrinsics=replace(first.given, fx=154.0))  # it has focused nearer
    refocused = first.corrected(other).intrinsics
    assert refocused.fx == pytest.approx(154 * 130 / 140)
    assert replace(refocused, fx=CAMERA.fx) == CAMERA
    tracker = Tracker(localizer())
    tracker._state = replace(tracker._state, camera=both)
    tracker.save(tmp_path / "state.safetensors")
    again = Tracker(localizer())
    again.restore(tmp_path / "state.safetensors")
    assert again._state.camera == both
