"""The motion model: predictions, fusion, and what keeps its covariance honest.

The filter shows in no answer by itself, hence ``Motion`` and ``Clock``.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bidnerf import SE3
from bidnerf_core.geometry import retract, update_between
from bidnerf_core.localization.propose import pixel_radius

# Inside: predictions and covariances of the filter, which show in no answer by themselves
from bidnerf_core.localization.tracking.motion import LONGEST_GAP, Clock, Motion, PoseEstimate

VELOCITY = torch.tensor([0.3, -0.1, 0.2, 0.2, 0.4, -0.1], dtype=torch.float64)


def covariance(scale: float, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    root = torch.randn((6, 6), generator=generator, dtype=torch.float64)
    return scale**2 * (root @ root.T + torch.eye(6, dtype=torch.float64))


def path(seconds: float) -> SE3:
    return SE3.exp(VELOCITY * seconds)


def measured(T: SE3, noise: float = 1e-3, bias: float = 0.0) -> PoseEstimate:
    return PoseEstimate(T, covariance(noise), covariance(bias, 1) if bias else torch.zeros((6, 6)).double())


def test_a_constant_velocity_is_learnt_and_predicted() -> None:
    motion = Motion.at(measured(path(0.0)), 1.0)
    for number in range(1, 8):
        motion = motion.predict(0.1).correct(measured(path(0.1 * number)))
    assert torch.allclose(motion.velocity, VELOCITY, atol=0.02)
    ahead = motion.predict(0.1).T_world_camera
    assert torch.allclose(ahead.matrix(), path(0.8).matrix(), atol=0.005)


def test_prediction_forth_and_back_returns() -> None:
    motion = Motion.at(measured(path(0.0)), 1.0).move(path(0.1), covariance(1e-3), 0.1)
    there = motion.predict(0.2).predict(-0.2)
    assert torch.allclose(there.T_world_camera.matrix(), motion.T_world_camera.matrix(), atol=1e-12)


@pytest.mark.parametrize("seconds", [0.0, 0.03, -0.1, LONGEST_GAP + 1])
def test_uncertainty_grows_with_time_and_stays_a_covariance(seconds: float) -> None:
    motion = Motion.at(measured(path(0.0), bias=1e-3), 1.0)
    later = motion.predict(seconds)
    assert float(later.noise.diagonal()[:6].sum()) > float(motion.noise.diagonal()[:6].sum())
    assert bool((torch.linalg.eigvalsh(later.noise) > 0).all())


def test_a_long_gap_keeps_the_pose() -> None:
    motion = Motion.at(measured(path(0.0)), 1.0).move(path(0.1), covariance(1e-3), 0.1)
    later = motion.predict(2 * LONGEST_GAP)
    assert torch.equal(later.T_world_camera.matrix(), motion.T_world_camera.matrix())
    assert float(later.noise[0, 0]) > LONGEST_GAP**2  # it may have moved at the speed of a camera


def test_fusing_equals_the_product_of_gaussians() -> None:
    """For small offsets, the pose is the information-weighted mean, and informations add."""
    prior, other = covariance(1e-3, 2), covariance(2e-3, 3)
    off = 1e-4 * torch.ones(6, dtype=torch.float64)
    motion = Motion.at(PoseEstimate(SE3.identity(), prior, torch.zeros((6, 6)).double()), 1.0)
    fused = motion.correct(PoseEstimate(SE3.exp(off), other, torch.zeros((6, 6)).double()))
    expected = torch.linalg.inv(torch.linalg.inv(prior) + torch.linalg.inv(other))
    assert torch.allclose(fused.noise[:6, :6], expected, rtol=1e-6, atol=1e-12)
    mean = expected @ torch.linalg.inv(other) @ off
    assert torch.allclose(fused.T_world_camera.log(), mean, atol=1e-9)


def test_bias_does_not_average_out() -> None:
    """Hundreds of frames of one map are no more accurate than the map."""
    bias = covariance(2e-3, 1)
    motion = Motion.at(PoseEstimate(SE3.identity(), covariance(1e-3), bias), 1.0)
    for _ in range(200):
        motion = motion.predict(1e-3).correct(PoseEstimate(SE3.identity(), covariance(1e-3), bias))
    assert torch.allclose(motion.bias, bias, rtol=1e-6, atol=1e-12)
    least = torch.linalg.eigvalsh(motion.covariance - 0.999 * bias)[0]
    assert float(least) > 0
    assert float(motion.noise[:6, :6].diagonal().sum()) < float(covariance(1e-3).diagonal().sum())


def test_a_moved_world_changes_nothing() -> None:
    world = SE3.exp(torch.tensor([1.0, -2.0, 0.5, 0.4, -1.0, 0.3], dtype=torch.float64))
    one, two = (Motion.at(measured(T @ path(0.0)), 1.0) for T in (SE3.identity(), world))
    for number in range(1, 4):
        one = one.predict(0.1).correct(measured(path(0.1 * number)))
        two = two.predict(0.1).correct(measured(world @ path(0.1 * number)))
    assert torch.allclose(two.T_world_camera.matrix(), (world @ one.T_world_camera).matrix(), atol=1e-10)
    assert torch.allclose(two.noise, one.noise, atol=1e-10)


def test_a_larger_scene_has_the_same_motion_in_larger_units() -> None:
    small, large = (Motion.at(measured(path(0.0), 1e-9), reach).predict(0.1) for reach in (1.0, 10.0))
    ratio = large.noise.diagonal()[:3] / small.noise.diagonal()[:3]
    assert torch.allclose(ratio, torch.full((3,), 100.0, dtype=torch.float64), rtol=1e-3)


def test_the_radius_in_pixels_is_that_of_projected_samples() -> None:
    spread = torch.diag(torch.tensor([0.01, 0.01, 0.01, 0.02, 0.02, 0.02]).double() ** 2)
    generator = torch.Generator().manual_seed(0)
    xi = torch.randn((4000, 6), generator=generator, dtype=torch.float64) @ spread.sqrt()
    point = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    seen = SE3.exp(xi).inverse().apply(point)
    sampled = float((300 * seen[:, :2] / seen[:, 2:]).std())
    assert pixel_radius(spread, 300.0, 2.0) == pytest.approx(sampled, rel=0.05)


def test_the_clock_fills_in_missing_times() -> None:
    clock = Clock(None, 0.5)
    clock, seconds = clock.step(10.0)
    assert seconds == 0.5
    clock, seconds = clock.step(10.1)
    assert seconds == pytest.approx(0.1)
    clock, seconds = clock.step(None)
    assert (clock.now, seconds) == (pytest.approx(10.2), pytest.approx(0.1))
    clock, seconds = clock.step(10.15)
    assert seconds == pytest.approx(-0.05)


def test_an_unforeseen_pose_restarts_the_motion() -> None:
    motion = Motion.at(measured(path(0.0)), 1.0).move(path(0.1), covariance(1e-3), 0.1).predict(0.1)
    near, far = measured(path(0.2)), measured(path(0.2).retract(torch.full((6,), 0.8).double()))
    assert torch.equal(motion.update(near).velocity, motion.correct(near).velocity)
    assert torch.equal(motion.update(far).T_world_camera.matrix(), far.T_world_camera.matrix())
    assert not motion.update(far).velocity.any()


@pytest.mark.parametrize("unknown", [float("nan"), float("inf")])
def test_a_pose_of_unknown_covariance_carries_no_information(unknown: float) -> None:
    motion = Motion.at(measured(path(0.0)), 1.0).predict(0.1)
    nothing = torch.full((6, 6), unknown, dtype=torch.float64)
    assert motion.update(PoseEstimate(path(0.5), nothing, nothing)) is motion


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.1, 3.1])
def test_maps_of_single_poses_equal_those_of_batches(angle: float) -> None:
    generator = torch.Generator().manual_seed(1)
    tangent = torch.randn(6, generator=generator, dtype=torch.float64)
    tangent[3:] *= angle / tangent[3:].norm()
    T = path(1.5)
    moved = retract(T, tangent)
    assert torch.allclose(moved.matrix(), T.retract(tangent).matrix(), atol=1e-12)
    assert torch.allclose(update_between(T, moved), tangent, atol=1e-9)


def smooth(seconds: float, jerk: float = 0.0) -> PoseEstimate:
    return measured(path(seconds).retract(torch.tensor([jerk, 0, 0, 0, 0, 0], dtype=torch.float64)))


def test_a_camera_that_keeps_its_velocity_is_predicted_ever_more_certainly() -> None:
    """The accelerations that the filter expects follow those that it sees, up and down."""
    motion, sizes = Motion.at(smooth(0.0), 1.0), []
    for number in range(1, 20):
        predicted = motion.predict(0.1)
        sizes.append(float(predicted.noise.diagonal()[:3].sum()))
        motion = predicted.update(smooth(0.1 * number))
    assert sizes[-1] < 0.2 * sizes[3]
    calm = motion.agility
    for number, jerk in enumerate((0.01, -0.012, 0.01, -0.01, 0.012), 20):
        motion = motion.predict(0.1).update(smooth(0.1 * number, jerk))
    assert motion.agility > 1.5 * calm


def test_a_velocity_that_is_not_known_says_nothing_about_accelerations() -> None:
    motion = Motion.at(smooth(0.0), 1.0).predict(0.1).update(smooth(0.1))
    assert motion.agility == 1.0


def test_a_pose_that_is_fused_already_corrects_the_velocity_as_the_measurement_would() -> None:
    """The oracle is fusion by the filter, of a measurement that shares half of its variance with the other frames."""
    predicted = Motion.at(measured(path(0.0)), 1.0).correct(measured(path(0.0))).predict(0.1)
    information = torch.linalg.inv(covariance(1e-3))
    direct = predicted.correct(measured(path(0.1)))
    again = predicted.refine(direct.T_world_camera, information)
    assert torch.allclose(again.velocity, direct.velocity, atol=1e-6)
    assert torch.allclose(again.covariance, direct.noise[:6, :6], atol=1e-12)
    unchanged = predicted.refine(predicted.T_world_camera, 0 * information)
    assert torch.allclose(unchanged.noise, predicted.noise, atol=1e-12)
    assert torch.allclose(unchanged.bias, predicted.bias, atol=1e-12)


def test_a_way_of_unknown_duration_is_uncertain_by_its_length() -> None:
    motion = Motion.at(smooth(0.0), 1.0).move(path(0.1), covariance(1e-3), 0.1)
    known, unknown = motion.predict(0.1), motion.predict(0.1, stamped=False)
    added = (unknown.noise - known.noise).diagonal()
    way = motion.velocity[:3].norm() * 0.1
    turn = motion.velocity[3:].norm() * 0.1
    expected = torch.cat([(0.5 * way).expand(3), (0.5 * turn).expand(3), torch.zeros(6).double()]) ** 2
    assert torch.allclose(added, expected)
    assert torch.equal(unknown.T_world_camera.matrix(), known.T_world_camera.matrix())
