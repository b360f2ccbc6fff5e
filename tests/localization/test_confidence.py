"""Confidence: the logistic model, its features, and how it enters the verdict.

The model is needed here for its weights and features.
"""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

# Inside: the weights and features of the model, of which an answer shows one probability
from bidnerf_core.localization import (
    LandmarkDiagnostics,
    Outcome,
    Support,
    SurfaceDiagnostics,
    Verdict,
    confidence,
)

GOOD = LandmarkDiagnostics(
    inliers=300, matches=400, agreeing=350, log10_nfa=-300.0, chance=4.0, visible=900, keypoints=1500, spread=0.7,
    noise_ratio=1.0, miscalibration=0.02, precision=0.003, estimated_calibration=False, searched=True,
)  # fmt: skip
FINE = Verdict(Outcome.CONVERGED, "fine")


@pytest.fixture(scope="module")
def learning() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
        return importlib.import_module("confidence")


def test_a_good_pose_by_landmarks_is_accepted_and_a_poor_one_is_not() -> None:
    poor = replace(GOOD, inliers=16, agreeing=8, chance=5.0, noise_ratio=4.0, precision=0.02, spread=0.1)
    good, bad = (confidence.judged(FINE, d) for d in (GOOD, poor))
    assert good == replace(FINE, confidence=good.confidence)
    assert bad.outcome is Outcome.UNCERTAIN
    assert "likely to be right" in bad.reason
    assert good.confidence is not None
    assert bad.confidence is not None
    assert 0 <= bad.confidence < confidence.ACCEPTED <= good.confidence <= 1


def test_a_rejection_stays_what_it_is() -> None:
    no = Verdict(Outcome.TOO_FEW_MATCHES, "no")
    found = confidence.judged(no, GOOD)
    assert found == replace(no, confidence=found.confidence)


def test_a_rejection_for_a_reason_that_the_confidence_ignores_states_none() -> None:
    sure = SurfaceDiagnostics(0.9, 0.5, 0.0, 0.3, support=Support(1.0, 9.0, 9.0, 9.0))
    assert sure.verdict().confidence == sure.support.confidence > confidence.ACCEPTED
    assert replace(sure, on_surface=0.5).verdict() == Verdict(
        Outcome.OFF_SURFACE, "only 50% of the measured points lie on the surface"
    )
    rivalled = replace(sure, support=Support(1.0, 9.0, 9.0, 0.0)).verdict()
    assert rivalled.outcome is Outcome.AMBIGUOUS
    assert rivalled.confidence == pytest.approx(0.5, abs=1e-3)
    assert Support(0.1, 9.0, 9.0, 9.0).rejection().confidence is None


def test_every_stored_weight_belongs_to_a_feature() -> None:
    assert set(confidence.model().features) == set(confidence.landmark_features(GOOD))
    assert np.isfinite(confidence.model().weights).all()


def test_features_are_finite_at_the_extremes() -> None:
    nothing = LandmarkDiagnostics(0, 0, 0.0, 0.0, 0, 0, 0, 0.0, 0.0, 1.0, float("inf"), False, False)
    assert np.isfinite(list(confidence.landmark_features(nothing).values())).all()


def test_probability_is_the_logistic_function() -> None:
    model = confidence.LogisticModel(("a", "b"), (2.0, -1.0), 0.5)
    assert model.probability({"a": 1.0, "b": 3.0}) == pytest.approx(1 / (1 + np.exp(0.5)))
    assert model.probability({"a": 1e6, "b": 0.0}) == 1.0


def test_the_fit_recovers_probabilities(learning: ModuleType) -> None:
    """Examples drawn from a known model give its probabilities back, but for what the ridge shrinks."""
    random = np.random.default_rng(0)
    true = confidence.LogisticModel(("a", "b"), (2.0, -1.0), 0.3)
    given = []
    for number in range(4000):
        features = dict(zip("ab", random.normal(size=2).tolist(), strict=True))
        right = bool(random.random() < true.probability(features))
        given.append(learning.Example(features, right, str(number % 2), str(number % 4)))
    found = learning.fitted(given, ridge=1e-5)
    for values in ({"a": 1.0, "b": 0.0}, {"a": -1.0, "b": 1.0}):
        assert found.probability(values) == pytest.approx(true.probability(values), abs=0.06)
    said = learning.cross_validated(given, by_fault=True)["all"]
    assert said["expected_calibration_error"] < 0.1


def test_no_feature_counts_against_its_meaning() -> None:
    """Fitted without bounds, the weights of related features had either sign, and more inliers lowered the confidence."""
    model = confidence.model()
    weight = dict(zip(model.features, model.weights, strict=True))
    for name in ("inliers", "above_chance", "recall", "agreement", "spread", "on_surface", "colour_inliers"):
        assert weight[name] >= 0
    for name in ("noise_ratio", "precision", "miscalibration"):
        assert weight[name] <= 0
