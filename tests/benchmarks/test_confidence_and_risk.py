"""How confidences are fitted to answers, and calibrated for a tolerated risk: the calibration keeps its promise."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from bidnerf_core.localization import LogisticModel
from localizations import answer_row


@pytest.fixture(scope="module")
def calibration(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("risk")


@pytest.fixture(scope="module")
def learning(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("confidence")


def test_the_fit_recovers_probabilities(learning: ModuleType) -> None:
    """Examples drawn from a known model give its probabilities back, but for what the ridge shrinks."""
    random = np.random.default_rng(0)
    true = LogisticModel({"a": 2.0, "b": -1.0}, 0.3)
    given = []
    for number in range(4000):
        features = dict(zip("ab", random.normal(size=2).tolist(), strict=True))
        right = bool(random.random() < true.probability(features))
        given.append(learning.Example(features, right, str(number % 2), str(number % 4)))
    found = learning.fit_model(given, ridge=1e-5)
    for values in ({"a": 1.0, "b": 0.0}, {"a": -1.0, "b": 1.0}):
        assert found.probability(values) == pytest.approx(true.probability(values), abs=0.06)
    said = learning.cross_validate(given, by_fault=True)["all"]
    assert said["expected_calibration_error"] < 0.1


def row(confidence: float, right: bool, fault: str, scene: str = "a") -> Any:
    names = {"scene": scene, "mode": "RGB", "fault": fault, "frame": "0"}
    return answer_row(0.01 if right else 9.0, confidence=confidence, diagnostics={"inliers": 50}, **names)


def falling(confidence: np.ndarray) -> np.ndarray:
    return 0.4 * (1 - confidence)


@pytest.mark.parametrize(
    ("wrong", "tolerated"),
    [
        (falling, 0.1),
        (falling, 0.05),
        (lambda confidence: np.where(confidence > 0.8, 0.08, 0.03), 0.05),  # the most confident ones are the worst
        (lambda confidence: np.full_like(confidence, 0.0501), 0.05),  # barely too many
    ],
)
def test_the_stated_risk_is_exceeded_as_rarely_as_promised(
    calibration: ModuleType, wrong: Callable[[np.ndarray], np.ndarray], tolerated: float
) -> None:
    """Over repeated draws of the examples, the true share of wrong answers above the threshold is rarely above the risk."""
    random, repeats = np.random.default_rng(0), 300
    grid = (np.arange(10**4) + 0.5) / 10**4  # confidences are uniform
    exceeded = 0
    for _ in range(repeats):
        confidences = random.random(1000)
        right = random.random(1000) >= wrong(confidences)
        least = calibration.least_confidence(confidences, right, tolerated)
        exceeded += least < 1 and wrong(grid[grid >= least]).mean() > tolerated
    noise = 3 * math.sqrt(calibration.ERROR * (1 - calibration.ERROR) / repeats)
    assert exceeded / repeats <= calibration.ERROR + noise


def test_many_good_answers_are_not_all_given_up(calibration: ModuleType) -> None:
    random = np.random.default_rng(1)
    confidences = random.random(8000)
    right = random.random(8000) >= falling(confidences)
    # The share of wrong answers above t is 0.2 (1 - t): below 0.05 for t > 0.75.
    assert 0.75 < calibration.least_confidence(confidences, right, 0.05) < 0.85


def test_a_threshold_takes_enough_examples(calibration: ModuleType) -> None:
    few = 20
    assert calibration.least_confidence([0.9] * few, [True] * few, 0.01) == math.inf
    assert calibration.least_confidence([], [], 0.01) == math.inf
    many = 2000
    assert calibration.least_confidence([0.9] * many, [True] * many, 0.01) == 0.9
    assert calibration.least_confidence([0.9] * many, [False] * many, 0.1) == math.inf


def test_a_larger_risk_never_requires_more_confidence(calibration: ModuleType) -> None:
    random = np.random.default_rng(2)
    for _ in range(20):
        said = random.random(300)
        rows = [row(p, random.random() < p, "none") for p in said]
        least = list(calibration.calibrate(rows).values())
        assert least == sorted(least, reverse=True)


def test_halves_share_no_fault_of_a_scene(calibration: ModuleType) -> None:
    rows = [row(0.9, True, fault, scene) for scene in "abc" for fault in ("none", "blur", "crop") * 2]
    one, other = calibration.halves(rows, seed=3)
    assert len(one) + len(other) == len(rows)
    assert not {(r["scene"], r["fault"]) for r in one} & {(r["scene"], r["fault"]) for r in other}
    assert {r["scene"] for r in one} == {r["scene"] for r in other} == set("abc")


def test_counts_of_a_test(calibration: ModuleType) -> None:
    rows = [row(0.9, True, "none"), row(0.7, False, "none"), row(0.7, True, "blur"), row(0.2, True, "blur")]
    found = calibration.count_outcomes([(r, dict.fromkeys(calibration.RISKS, 0.7)) for r in rows])["0.1"]
    assert found == {"accepted": 3, "wrong": 1, "right_lost": 1}
