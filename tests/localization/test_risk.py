"""Tolerated risk: the calibration keeps its promise, and a smaller risk accepts fewer answers."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from bidnerf_core import Localizer, Tracker

# Inside: the calibrated levels, and poses on either side of them
from bidnerf_core.localization import AutoConfig, Outcome, risk
from bidnerf_core.testing import textured_map, unseen
from localizations import answer
from refusals import refused

LEVELS = ((0.01, 0.97), (0.05, 0.9), (0.1, 0.8))


@pytest.fixture(scope="module")
def calibration() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
        return importlib.import_module("risk")


@pytest.fixture
def levels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(risk, "levels", lambda: LEVELS)


def row(confidence: float, right: bool, fault: str, scene: str = "a", inliers: int = 50) -> dict[str, Any]:
    return {
        "scene": scene, "mode": "RGB", "fault": fault, "frame": "0", "converged": True, "confidence": confidence,
        "translation": 0.01 if right else 1.0, "rotation_deg": 0.1, "diagnostics": {"inliers": inliers},
    }  # fmt: skip


def falling(confidence: np.ndarray) -> np.ndarray:
    return 0.4 * (1 - confidence)


def overconfident(confidence: np.ndarray) -> np.ndarray:
    """Return the probability of a wrong answer where the most confident ones are the worst."""
    return np.where(confidence > 0.8, 0.08, 0.03)


def barely_too_many(confidence: np.ndarray) -> np.ndarray:
    return np.full_like(confidence, 0.0501)


@pytest.mark.parametrize(
    ("wrong", "tolerated"), [(falling, 0.1), (falling, 0.05), (overconfident, 0.05), (barely_too_many, 0.05)]
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
        least = list(calibration.calibrated(rows).values())
        assert least == sorted(least, reverse=True)


def test_halves_share_no_fault_of_a_scene(calibration: ModuleType) -> None:
    rows = [row(0.9, True, fault, scene) for scene in "abc" for fault in ("none", "blur", "crop") * 2]
    one, other = calibration.halves(rows, seed=3)
    assert len(one) + len(other) == len(rows)
    assert not {(r["scene"], r["fault"]) for r in one} & {(r["scene"], r["fault"]) for r in other}
    assert {r["scene"] for r in one} == {r["scene"] for r in other} == set("abc")


def test_counts_of_a_test(calibration: ModuleType) -> None:
    rows = [row(0.9, True, "none"), row(0.7, False, "none"), row(0.7, True, "blur"), row(0.2, True, "blur")]
    found = calibration.realised([(r, dict.fromkeys(calibration.RISKS, 0.7)) for r in rows])["0.1"]
    assert found == {"accepted": 3, "wrong": 1, "right_lost": 1}


def test_stored_levels_are_monotone() -> None:
    risks, least = [share for share, _ in risk.levels()], [confidence for _, confidence in risk.levels()]
    assert risks == sorted(set(risks))
    assert least == sorted(least, reverse=True)
    assert all(0 < share < 1 for share in risks)
    assert all(0 <= confidence <= 1 for confidence in least)


@pytest.mark.usefixtures("levels")
def test_a_smaller_risk_accepts_a_subset() -> None:
    answers = [answer(confidence=value) for value in np.linspace(0.5, 1, 101)]
    accepted = [
        {place for place, found in enumerate(answers) if risk.within_risk(found, share).converged}
        for share in (0.01, 0.03, 0.05, 0.07, 0.1)
    ]
    for fewer, more in pairwise(accepted):
        assert fewer <= more
    assert len(accepted[0]) < len(accepted[2]) < len(accepted[4]) < len(answers)
    assert accepted[1] == accepted[0]  # between two levels, the stricter one holds


@pytest.mark.usefixtures("levels")
def test_what_is_not_sure_enough_is_uncertain_with_the_same_pose() -> None:
    found = answer(confidence=0.95)
    judged = risk.within_risk(found, 0.01)
    assert judged.outcome is Outcome.UNCERTAIN
    assert judged.T_world_camera is found.T_world_camera
    assert judged.confidence == 0.95
    assert "0.950" in judged.reason
    assert "0.970" in judged.reason
    assert found.reason in judged.reason


@pytest.mark.usefixtures("levels")
def test_an_answer_without_a_confidence_is_not_accepted_at_any_risk() -> None:
    assert risk.within_risk(answer(), 0.1).outcome is Outcome.UNCERTAIN


@pytest.mark.usefixtures("levels")
def test_a_rejection_stays_what_it_is() -> None:
    found = answer(outcome=Outcome.MIRRORED, confidence=0.99)
    assert risk.within_risk(found, 0.1) is found


@pytest.mark.usefixtures("levels")
@pytest.mark.parametrize("share", [0.0, 0.009, 0.11, 1.0, -1.0, math.nan, math.inf, "0.05"])
def test_a_risk_that_was_not_calibrated_is_refused(share: Any) -> None:
    with refused(found=f"risk is {share!r}", expected="0.01 to 0.1"):
        AutoConfig(risk=share)


def test_without_calibration_every_risk_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(risk, "levels", lambda: ())
    AutoConfig()
    with refused(found="risk is 0.05, but no risk was calibrated"):
        AutoConfig(risk=0.05)


@pytest.mark.parametrize("search", ["localizer", "tracker"])
def test_the_localizer_and_the_search_of_a_tracker_keep_to_it(
    search: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(risk, "levels", lambda: ((0.01, 1.0), (0.1, 0.5)))
    found = []
    for share in (None, 0.1, 0.01):
        localizer = Localizer(textured_map(), config=AutoConfig(fused_rays=0, risk=share), warm_up=False)
        frame = unseen().frame
        each = localizer(frame) if search == "localizer" else Tracker(localizer)(frame, 0.0)
        found.append(each)
    assert [each.converged for each in found] == [True, True, False]
    for each in found[1:]:
        assert torch.equal(each.T_world_camera.matrix(), found[0].T_world_camera.matrix())
        assert each.confidence == found[0].confidence
