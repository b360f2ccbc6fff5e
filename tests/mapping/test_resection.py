"""Resection: derivatives, what it recovers, and how certain it is of that."""

from __future__ import annotations

import math
from dataclasses import astuple, replace

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime
from scipy.stats import chi2
from torch import Tensor

from bidnerf_core import SE3, Intrinsics
from bidnerf_core.camera import MotionPrior, exposure_times
from bidnerf_core.localization import Motion, Posterior

# Inside: probabilities of a motion for given observations, of which a pose shows the decision
from bidnerf_core.localization.landmarks.hypotheses import (
    MIN_POINTS,
    SHARE_MOVING,
    camera_hypotheses,
    posterior,
)
from bidnerf_core.mapping import (
    FIXED,
    GIVEN,
    NOMINAL,
    STRETCHED,
    Calibration,
    ObservedPoints,
    ReprojectionErrors,
    State,
    log_likelihood_ratio,
    resect,
)
from observed_points import FOCAL, HEIGHT, TRUE, observed


def error(T: SE3) -> float:
    return float((T.inverse() @ TRUE).log().norm())


NEAR = TRUE.retract(torch.full((6,), 0.03, dtype=torch.float64))
WRONG = Calibration(0.05, 0.01, -0.02, 0.03, 0.04)


def test_the_gradient_is_the_numerical_one() -> None:
    data, free = observed(noise=1.0), np.arange(5)
    residuals = ReprojectionErrors(data, NEAR)
    state = State.of(NEAR, WRONG)

    def cost(step: np.ndarray) -> float:
        return residuals.system(residuals.linearized(state.retracted(step, free), free), 0.7).cost

    numerical = approx_fprime(np.zeros(11), cost, 1e-7)
    gradient = residuals.system(residuals.linearized(state, free), 0.7).gradient
    np.testing.assert_allclose(gradient, numerical, rtol=2e-3, atol=1e-2)


def test_exact_observations_give_the_exact_pose() -> None:
    assert error(resect(observed(), NEAR, 1.0).T_world_rig) < 1e-9


def test_a_wrong_calibration_is_found_where_it_is_open() -> None:
    data = observed(calibration=WRONG)
    found = resect(data, NEAR, 2.0, STRETCHED)
    for part, truth in zip(astuple(found.calibration), astuple(WRONG), strict=True):
        assert part == pytest.approx(truth, abs=2e-3)
    assert error(found.T_world_rig) < 5e-3
    assert error(resect(data, NEAR, 2.0, FIXED).T_world_rig) > 0.05


def test_corrected_observations_are_those_of_the_true_camera() -> None:
    corrected = observed(calibration=WRONG).corrected(WRONG)
    assert float(corrected.residuals(TRUE).abs().max()) < 1e-5


def test_applied_intrinsics_project_as_the_calibration_does() -> None:
    given = Intrinsics(FOCAL, FOCAL, 320.0, 240.0, 640, 480)
    flat = torch.tensor([[0.3, -0.2], [-0.5, 0.4]], dtype=torch.float64)
    points = torch.cat([flat, torch.ones(2, 1, dtype=torch.float64)], dim=-1)
    expected = WRONG.pixels(flat, FOCAL) + torch.tensor([320.0, 240.0])
    torch.testing.assert_close(WRONG.applied(given).project(points), expected)


def test_the_covariance_is_that_of_many_trials_and_scales_with_correlation() -> None:
    squared = []
    for seed in range(60):
        fit = resect(observed(noise=0.5, seed=seed), TRUE, 1.0)
        update = (fit.T_world_rig.inverse() @ TRUE).log()
        squared.append(float(update @ torch.linalg.solve(fit.covariance, update)))
    assert 4.5 < np.mean(squared) < 8  # of six degrees of freedom: 6
    data = observed(noise=0.5)
    one, four = (resect(data, TRUE, 1.0, correlation=c).covariance for c in (1.0, 4.0))
    torch.testing.assert_close(four, 4 * one, rtol=0.2, atol=1e-7)


def test_the_covariance_of_few_points_is_not_much_too_small() -> None:
    """The scatter of the single gradients alone leaves half of the poses outside."""
    inside = 0
    for seed in range(60):
        fit = resect(observed(20, noise=0.5, seed=seed), TRUE, 1.0)
        update = (fit.T_world_rig.inverse() @ TRUE).log()
        inside += float(update @ torch.linalg.solve(fit.covariance, update)) < chi2.ppf(0.95, 6)
    assert inside >= 42


def test_fits_are_compared_by_how_likely_they_make_the_observations() -> None:
    """Small residuals with Gaussian noise count by half the difference of their squares in standard deviations."""
    data = observed(noise=0.5, calibration=WRONG)
    free, fixed = (resect(data, NEAR, 2.0, prior) for prior in (NOMINAL, FIXED))
    ratio = log_likelihood_ratio(data, free, fixed)
    assert ratio > 50
    assert log_likelihood_ratio(data, fixed, free) == pytest.approx(-ratio)
    assert log_likelihood_ratio(data, free, fixed, correlation=4.0) == pytest.approx(ratio / 4)
    assert log_likelihood_ratio(data, free, free) == 0
    exact = resect(observed(), TRUE, 1.0)
    near = replace(exact, T_world_rig=TRUE.retract(torch.full((6,), 1e-6, dtype=torch.float64)))
    squares = observed().residuals(near.T_world_rig).square().sum() / exact.noise**2
    assert log_likelihood_ratio(observed(), exact, near) == pytest.approx(0.5 * float(squares), rel=0.01)


def test_fits_with_the_same_residuals_are_as_likely_whatever_the_errors_of_the_points() -> None:
    """A frontal plane looks the same with a shorter focal length from nearer by, where the points' errors are larger in pixels."""
    data = observed(noise=0.3)
    local = TRUE.inverse().apply(data.points)
    plane = replace(
        data,
        points=TRUE.apply(local * (4 / local[:, 2:])),
        deviations=torch.full_like(data.deviations, 0.01),
    )
    fit = resect(plane, TRUE, 1.0)
    back = TRUE.retract(torch.tensor([0.0, 0.0, -0.4, 0.0, 0.0, 0.0], dtype=torch.float64))
    longer = replace(fit, T_world_rig=back, calibration=Calibration(log_focal=math.log(1.1)))
    fit = replace(fit, T_world_rig=TRUE)
    assert log_likelihood_ratio(plane, fit, longer) == pytest.approx(0, abs=1e-6)


def test_outliers_do_not_move_the_pose() -> None:
    data = observed(noise=0.2)
    image = data.image.clone()
    image[::4] += 0.1  # 40 pixels
    assert error(resect(replace(data, image=image), NEAR, 2.0).T_world_rig) < 2e-3


MOTION = torch.tensor([0.01, -0.02, 0.005, 0.01, 0.005, -0.015], dtype=torch.float64)
OPEN = MotionPrior(move=0.05, turn=0.02)


def observed_while_moving(motion: Tensor, noise: float = 0.0, seed: int = 0) -> ObservedPoints:
    """Return the same points as seen by a camera whose pose at each row is the exponential of the motion so far."""
    data = observed(seed=seed)
    local = TRUE.inverse().apply(data.points)
    times = data.exposure_times
    for _ in range(20):  # the row on which a point appears depends on the pose at that row
        there = SE3.exp(-times[:, None] * motion).apply(local)
        image = there[:, :2] / there[:, 2:]
        times = image[:, 1] * FOCAL / HEIGHT
    random = torch.Generator().manual_seed(seed + 1)
    off = noise / FOCAL * torch.randn(image.shape, generator=random, dtype=torch.float64)
    return replace(data, image=image + off, exposure_times=times)


@pytest.mark.parametrize(("moved", "tolerance"), [(0.0, 2e-3), (1.0, 0.02)])
def test_the_gradient_by_the_motion_is_nearly_the_numerical_one(moved: float, tolerance: float) -> None:
    """Without a motion it is exact; with one, the derivatives leave out how it turns them."""
    data, free = observed(noise=1.0), np.arange(5, 11)
    errors, state = ReprojectionErrors(data, NEAR), State.of(NEAR, motion=moved * MOTION)

    def cost(step: np.ndarray) -> float:
        return errors.system(errors.linearized(state.retracted(step, free), free), 0.7).cost

    numerical = approx_fprime(np.zeros(12), cost, 1e-7)
    gradient = errors.system(errors.linearized(state, free), 0.7).gradient
    size = np.abs(numerical).max()
    np.testing.assert_allclose(gradient, numerical, rtol=tolerance, atol=tolerance * size)


def test_a_motion_between_rows_is_found_and_no_longer_shifts_the_pose() -> None:
    data = observed_while_moving(MOTION)
    found = resect(data, NEAR, 0.1, motion=OPEN)
    torch.testing.assert_close(found.motion, MOTION, atol=3e-4, rtol=0)
    assert error(found.T_world_rig) < 3e-4
    assert error(resect(data, NEAR, 0.1).T_world_rig) > 10 * error(found.T_world_rig)
    without_motion = data.without_motion(found.T_world_rig, found.motion)
    assert float(without_motion.residuals(found.T_world_rig).norm(dim=-1).max()) < 0.1


def test_deviations_of_poses_with_motion_are_those_of_repeated_observations() -> None:
    fits = [resect(observed_while_moving(MOTION, 0.5, seed), TRUE, 0.5, motion=OPEN) for seed in range(40)]
    squared = [
        float((off := (TRUE.inverse() @ fit.T_world_rig).log()) @ torch.linalg.solve(fit.covariance, off))
        for fit in fits
    ]
    assert 4 < sum(squared) / len(squared) < 9  # chi-squared with six degrees of freedom


def judged(data: ObservedPoints, T: SE3) -> Posterior:
    """What explains an image of a map whose own images need no corrections, with the given intrinsics as the best."""
    sure = torch.full((4,), 1e-4, dtype=torch.float64)
    return posterior(data, T, 0.5, camera_hypotheses([]), 1.0, GIVEN, sure, SHARE_MOVING).with_stated


@pytest.mark.parametrize(
    ("motion", "evident"), [(MOTION, True), (0 * MOTION, False)], ids=["moving", "still"]
)
@pytest.mark.parametrize("count", [40, 200])
def test_a_motion_is_evident_where_there_was_one(motion: Tensor, evident: bool, count: int) -> None:
    chosen = 0
    for seed in range(20):
        data = observed_while_moving(motion, 0.5, seed)[torch.arange(count)]
        chosen += judged(data, resect(data, TRUE, 0.5).T_world_rig).best.motion is Motion.MOVING
    assert chosen >= 19 if evident else chosen <= 1


def test_few_points_tell_no_motion() -> None:
    for count in (6, MIN_POINTS - 1):
        found = judged(observed_while_moving(MOTION)[torch.arange(count)], TRUE)
        assert found.best.motion is Motion.STILL
        assert float(found.doubt_of_motion.abs().max()) < 1e-9


def test_the_posterior_of_a_motion_has_the_width_that_the_cost_says() -> None:
    """The evidence by Laplace's approximation takes the curvature of the cost, which is not the scatter of estimates."""
    data = observed_while_moving(MOTION, 0.5)
    fit = resect(data, TRUE, 0.5, motion=OPEN)
    errors, free = ReprojectionErrors(data, fit.T_world_rig), np.arange(5, 11)
    state = State.of(fit.T_world_rig, motion=fit.motion)
    prior = OPEN.deviations.numpy()

    def gradient(step: np.ndarray) -> np.ndarray:
        moved = state.retracted(step, free)
        system = errors.system(errors.linearized(moved, free), fit.noise)
        return system.with_prior(moved.camera[free], prior).gradient

    curvature = np.array(
        [approx_fprime(np.zeros(12), lambda step, i=i: gradient(step)[i], 1e-6) for i in range(12)]
    )
    width = np.linalg.inv((curvature + curvature.T) / 2)[6:, 6:]
    np.testing.assert_allclose(
        np.linalg.slogdet(width)[1], float(torch.logdet(fit.motion_posterior)), atol=0.3
    )


def test_rows_of_upright_images_are_their_columns() -> None:
    pixels = torch.tensor([[0.0, 0.0], [320.0, 120.0], [640.0, 480.0]])
    wide = Intrinsics(400.0, 400.0, 320.0, 240.0, 640, 480)
    upright = Intrinsics(400.0, 400.0, 240.0, 320.0, 480, 640)
    assert exposure_times(pixels, wide).tolist() == [-0.5, -0.25, 0.5]
    assert exposure_times(pixels.flip(-1), upright).tolist() == [-0.5, -0.25, 0.5]


def test_a_principal_point_is_told_from_a_motion_if_both_are_free() -> None:
    wrong = Calibration(shift_v=0.01)
    data = observed_while_moving(MOTION, noise=0.3)
    data = replace(data, image=data.image + torch.tensor([0.0, wrong.shift_v]))
    both = resect(data, TRUE, 0.5, NOMINAL, motion=OPEN)
    deviation = float(both.calibration_deviations[2])
    assert deviation < 0.003
    assert both.calibration.shift_v == pytest.approx(wrong.shift_v, abs=3 * deviation)
    torch.testing.assert_close(both.motion[3:], MOTION[3:], atol=3e-3, rtol=0)


def test_the_part_of_the_covariance_by_the_motion_is_what_a_known_motion_lacks() -> None:
    data = observed_while_moving(MOTION, noise=0.5)
    unknown = resect(data, TRUE, 0.5, motion=OPEN)
    known = resect(data.without_motion(unknown.T_world_rig, unknown.motion), TRUE, 0.5)
    rest = unknown.covariance - unknown.covariance_by_motion
    torch.testing.assert_close(rest.diagonal(), known.covariance.diagonal(), rtol=0.3, atol=0)
    assert not resect(data, TRUE, 0.5).covariance_by_motion.any()
