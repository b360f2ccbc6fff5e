"""Hypotheses about a camera: evidence and poses by linear algebra, against integrals and sampling.

``posterior`` is needed here for probabilities and for the pose of each explanation, of which answers show the best one only.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from bidnerf_core import Intrinsics
from bidnerf_core.localization import Posterior, Stated

# Inside: probabilities of hypotheses are compared with integrals and samples
from bidnerf_core.localization.landmarks.hypotheses import camera_hypotheses, posterior
from bidnerf_core.localization.landmarks.map_camera import map_cameras
from bidnerf_core.mapping import GIVEN, NOMINAL, Calibration, EliminatedPose, RobustEquations
from observed_points import TRUE, observed

CAMERA = Intrinsics(400.0, 400.0, 320.0, 240.0, 640, 480)
SURE = torch.full((4,), 1e-4, dtype=torch.float64)


def linear(seed: int = 0, parameters: int = 3) -> tuple[np.ndarray, np.ndarray, RobustEquations]:
    """Observations that depend linearly on six numbers of a pose and on a camera's parameters, with unit noise."""
    random = np.random.default_rng(seed)
    design = random.normal(size=(20, 6 + parameters))
    seen = random.normal(size=20) + design[:, 6:] @ random.normal(size=parameters)
    gradient, hessian = -design.T @ seen, design.T @ design
    equations = RobustEquations(
        0.5 * float(seen @ seen), gradient, hessian, hessian, 1.0, design, 1.0, 20, 0 * hessian
    )
    return design, seen, equations


def test_the_evidence_is_the_marginal_density_of_the_observations() -> None:
    """The pose has a flat prior: its density is that of a very wide one, which is the same for all hypotheses."""
    design, seen, system = linear()
    mean = np.array([[0.0, 0.0, 0.0], [0.5, -0.3, 0.2], [0.0, 1.0, 0.0]])
    deviations = np.array([[0.1, 0.2, 0.3], [1.0, 0.5, 0.05], [0.01, 2.0, 0.3]])
    spurious = np.array([0.1, 0.0, 0.2])
    found = EliminatedPose.of(system, np.zeros(3)).given(mean, deviations, spurious)
    expected = []
    for m, d in zip(mean, deviations, strict=True):
        width = np.concatenate([np.full(6, 1e3), np.hypot(d, spurious)])
        covariance = np.eye(20) + design * width**2 @ design.T
        expected.append(multivariate_normal(design[:, 6:] @ m, covariance).logpdf(seen))
    np.testing.assert_allclose(
        found.log_evidence - found.log_evidence[0], np.array(expected) - expected[0], atol=1e-4
    )


def test_the_pose_under_a_prior_is_that_of_the_joint_minimum() -> None:
    design, seen, system = linear()
    deviations = np.array([0.1, 0.2, 0.3])
    found = EliminatedPose.of(system, np.zeros(3)).given(np.zeros((1, 3)), deviations[None], np.zeros(3))
    precision = np.diag(np.concatenate([np.zeros(6), deviations**-2]))
    joint = np.linalg.solve(design.T @ design + precision, design.T @ seen)
    np.testing.assert_allclose(found.update[0], joint[:6], atol=1e-8)
    np.testing.assert_allclose(found.parameters[0], joint[6:], atol=1e-8)
    covariance = np.linalg.inv(design.T @ design + precision)[:6, :6]
    known = np.linalg.inv((design.T @ design)[:6, :6])
    np.testing.assert_allclose(found.covariance[0], covariance - known, atol=1e-8)


def test_spurious_corrections_leave_tied_parameters_where_they_are() -> None:
    _, _, system = linear()
    found = EliminatedPose.of(system, np.zeros(3)).given(np.zeros((1, 3)), np.zeros((1, 3)), np.full(3, 0.5))
    np.testing.assert_allclose(found.parameters[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found.covariance[0], 0.0, atol=1e-12)


def judged(
    true: Calibration, noise: float = 0.3, given: Intrinsics = CAMERA, correlation: float = 1.0
) -> Posterior:
    data = observed(noise=noise, calibration=true)
    known = map_cameras(given, (CAMERA,))
    return posterior(data, TRUE, noise, camera_hypotheses(known), correlation, GIVEN, SURE)


def probability(found: Posterior, group: str) -> float:
    weighted = zip(found.explanations, found.probabilities, strict=True)
    return sum(p for each, p in weighted if each.hypothesis.group == group)


@pytest.mark.parametrize(
    ("true", "name"),
    [
        (GIVEN, Stated.EXACT),
        (Calibration(log_focal=0.025), Stated.INEXACT),
        (Calibration(log_focal=0.08), Stated.WRONG),
        (Calibration(shift_u=0.09, shift_v=-0.04), Stated.CROPPED),
        (Calibration(log_focal=0.06, radial=0.06), Stated.WRONG),
    ],
)
def test_the_best_explanation_is_the_smallest_that_suffices(true: Calibration, name: str) -> None:
    data = observed(noise=0.3, calibration=true)
    found = posterior(data, TRUE, 0.3, camera_hypotheses([]), 1.0, GIVEN, SURE)
    assert found.best.hypothesis.name == name
    assert float((TRUE.inverse() @ found.pose(found.best)).log().norm()) < 0.02


def test_the_camera_of_the_map_explains_an_image_that_misstates_it() -> None:
    stated = Calibration(log_focal=-0.03).applied(CAMERA)
    found = judged(Calibration(log_focal=0.03), given=stated)
    assert found.best.hypothesis.camera == CAMERA
    assert judged(GIVEN, given=stated).best.hypothesis.name == Stated.EXACT


def test_keypoints_that_tell_nothing_leave_the_priors() -> None:
    found = judged(GIVEN, correlation=1e9)
    hypotheses = camera_hypotheses(map_cameras(CAMERA, (CAMERA,)))
    total = sum(np.exp(each.log_prior) for each in hypotheses)
    for each, p in zip(found.explanations, found.probabilities, strict=True):
        assert p == pytest.approx(np.exp(each.hypothesis.log_prior) / total, rel=0.05)


def test_evidence_is_added_as_log_odds() -> None:
    found = judged(GIVEN, correlation=1e9)
    before, after = (probability(each, "estimated") for each in (found, found.updated({"estimated": 2.0})))
    assert np.log(after / (1 - after)) - np.log(before / (1 - before)) == pytest.approx(2.0)


def test_approximate_intrinsics_are_estimated_in_any_case() -> None:
    data = observed(noise=0.3, calibration=Calibration(log_focal=0.15))
    found = posterior(data, TRUE, 0.3, camera_hypotheses([], NOMINAL), 1.0, GIVEN, SURE)
    assert found.best.hypothesis.name == "approximate"
    assert found.best.calibration.log_focal == pytest.approx(0.15, abs=0.01)
