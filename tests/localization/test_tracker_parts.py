"""Ways to measure a frame beside followed landmarks: colour alone, depth alone, depth beside landmarks, and odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from bidnerf_core import SE3, Frame, Localizer, Outcome, Tracker
from bidnerf_core.depth.sensors import KINECT
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
from bidnerf_core.localization.covariance import FINEST
from bidnerf_core.localization.tracking.flow import alike
from bidnerf_core.localization.tracking.measuring import followed
from bidnerf_core.localization.tracking.motion import Motion, PoseEstimate
from bidnerf_core.localization.tracking.points import FollowedPoints
from bidnerf_core.localization.tracking.recognition import LEAST_CORNERS, Odometry
from bidnerf_core.localization.tracking.state import TrackerState
from bidnerf_core.localization.tracking.surface import (
    aligned,
    fit_shape,
    fused_with_surface,
    measured_cloud,
)
from bidnerf_core.mapping import grey_image
from bidnerf_core.results import normalized_error_squared, pose_error
from bidnerf_core.testing import textured_map
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
        assert answer.covariance is not None
        assert float(normalized_error_squared(answer.T_world_camera, truth, answer.covariance)) < 16.8


def test_shape_corrects_what_it_determines_and_leaves_the_rest_to_the_prediction() -> None:
    _, frame, truth = flight()[2]
    surface = textured_map(surface=True).surface
    assert surface is not None
    cloud = measured_cloud(depth_only(frame), 400, 1.0, torch.Generator().manual_seed(0))
    up = truth.rotation.T @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    off = torch.cat([0.04 * up, torch.zeros(3).double()])
    predicted = PoseEstimate(truth.retract(off), covariance(0.04, 0.02), covariance(1e-3, 1e-3))
    found = fit_shape(surface, cloud, predicted, 0.05)
    assert found.verdict().accepted
    assert 3 <= found.determined < 6
    assert abs(float((found.pose.T_world_camera.translation - truth.translation)[2])) < 0.01
    axes = torch.stack([up, torch.linalg.cross(up, torch.tensor([1.0, 0.0, 0.0]).double())])
    vertical, level = (float(a @ found.pose.covariance[:3, :3] @ a / (a @ a)) ** 0.5 for a in axes)
    assert vertical < 0.02
    assert level > 0.029
    smaller = torch.linalg.eigvalsh(predicted.covariance - found.pose.covariance)
    assert float(smaller[0]) > -1e-9


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
    error = pose_error(motion.T_world_camera, T_second)
    assert float(error.translation) < 0.02
    assert float(error.rotation_deg) < 0.8
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


def test_corners_have_the_depth_noise_of_the_sensor() -> None:
    _, frame, T = flight()[0]
    corners = Odometry(100, 0.5, KINECT.noise).replenished(
        frame, grey_image(frame.rgb), FollowedPoints.none(), T
    )
    depth = T.inverse().apply(corners.positions)[:, 2]
    assert len(corners) > 0
    torch.testing.assert_close(corners.deviations[:, 1], KINECT.noise.quadratic * depth**2)


def test_corners_without_measured_depth_are_left_out() -> None:
    _, frame, T = flight()[0]
    odometry, image = Odometry(100, 0.5), grey_image(frame.rgb)
    none = FollowedPoints.none()
    assert len(odometry.replenished(without_depth(frame), image, none, T)) == 0
    half = frame.depth.clone() if frame.depth is not None else torch.zeros(0)
    half[:, : half.shape[1] // 2] = 0
    corners = odometry.replenished(replace(frame, depth=half), image, none, T)
    assert len(corners) > 0
    assert float(corners.pixels[:, 0].min()) >= half.shape[1] // 2 - 1


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
    off = pose_error(fused.T_world_camera, best)
    assert float(off.translation) < 1e-3
    assert float(off.rotation_deg) < 0.05
    smaller = torch.linalg.eigvalsh(start.covariance - fused.covariance)
    assert float(smaller[0]) > -1e-12
    assert bool((torch.linalg.eigvalsh(fused.noise) > 0).all())
    assert bool((torch.linalg.eigvalsh(fused.bias) > 0).all())


def test_depth_alone_is_aligned_from_a_prediction_that_is_off() -> None:
    """A prediction is off by a few centimetres and degrees."""
    _, frame, truth = flight()[2]
    surface = textured_map(surface=True).surface
    assert surface is not None
    cloud = measured_cloud(depth_only(frame), 400, 1.0, torch.Generator().manual_seed(0))
    assert not bool(cloud.coloured.any())
    predicted = truth.retract(3 * NEAR)
    found = aligned(surface, cloud, predicted, covariance(0.05, 0.05), 0.1)
    before, after = pose_error(predicted, truth), pose_error(found.T_world_camera, truth)
    assert float(after.rotation_deg) < 0.5 * float(before.rotation_deg)
    assert float(after.translation) < 0.3 * float(before.translation)
    assert found.diagnostics.verdict().accepted
