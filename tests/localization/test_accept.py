"""Acceptance: each bound rejects for its own reason, and the confidence of what keeps all of them."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from importlib import import_module
from importlib.resources import files
from itertools import pairwise
from typing import Any

import pytest
import torch

from bidnerf_core.localization import (
    ACCEPTED,
    LANDMARK_BOUNDS,
    AutoConfig,
    Bound,
    Evidence,
    LogisticModel,
    Outcome,
    features,
)

# Inside: the verdict of a record of evidence, and the model without any answer
from bidnerf_core.localization.accept import judge, least_confidence
from bidnerf_core.localization.auto import within_limits, within_risk
from localizations import answer
from optional import require
from refusals import refused

SOUND = Evidence(
    log10_nfa=-80.0,
    inliers=200,
    by_chance=2.0,
    recall=0.8,
    spread=0.6,
    noise_ratio=1.0,
    other_place=0.0,
    credible=1.0,
    replaced=0.0,
    precision=0.002,
    mass=1.0,
    searched=True,
)
COUNTS = ("inliers", "mirrored", "other_view")
UNSURE, SURE = LogisticModel({}, -1.0), LogisticModel({}, 8.0)
LEVELS = {"risk": {"least_confidence": [[0.01, 0.97], [0.05, 0.9], [0.1, 0.8]]}}


@pytest.fixture(autouse=True)
def sure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounds alone decide."""
    monkeypatch.setattr(import_module("bidnerf_core.localization.accept"), "model", lambda: SURE)


def beyond(bound: Bound, by: float) -> Evidence:
    """Return sound evidence but for one measure, which is beyond its bound, or within it if ``by`` is negative."""
    value = bound.limit - by if bound.is_least else bound.limit + by
    if bound.measure == "above_chance":
        return replace(SOUND, by_chance=(1 + SOUND.inliers) / value - 1)
    return replace(SOUND, **{bound.measure: value})


def test_what_keeps_all_bounds_is_accepted() -> None:
    found = judge(SOUND)
    assert found.outcome is Outcome.CONVERGED
    assert found.reason == "200 landmark inliers"


@pytest.mark.parametrize("bound", LANDMARK_BOUNDS, ids=lambda bound: bound.measure)
def test_each_bound_alone_rejects_with_its_outcome_and_reason(bound: Bound) -> None:
    step = 1 if bound.measure in COUNTS else 1e-3 * abs(bound.limit)
    within, out = judge(beyond(bound, -step)), judge(beyond(bound, step))
    assert within.accepted, within.reason
    assert out.outcome is bound.outcome
    first, last = (part.strip() for part in (bound.reason.split("{")[0], bound.reason.split("}")[-1]))
    assert out.reason.startswith(first)
    assert out.reason.endswith(last)


@pytest.mark.parametrize("bound", LANDMARK_BOUNDS, ids=lambda bound: bound.measure)
def test_what_is_not_a_number_is_not_accepted(bound: Bound) -> None:
    if bound.measure not in COUNTS:
        name = "by_chance" if bound.measure == "above_chance" else bound.measure
        assert not judge(replace(SOUND, **{name: math.nan})).accepted


@pytest.mark.parametrize(("inliers", "difference", "accepted"), [(12, None, False), (12, 1.0, True), (9, 1.0, False)])
def test_fewer_inliers_suffice_where_rays_confirm_them(inliers: int, difference: float | None, accepted: bool) -> None:
    assert judge(replace(SOUND, inliers=inliers, difference=difference)).accepted is accepted


def test_of_several_reasons_the_most_serious_is_stated() -> None:
    for one, other in pairwise(LANDMARK_BOUNDS):
        both = {
            field.name: getattr(part, field.name)
            for part in (beyond(other, 1e-3), beyond(one, 1 if one.measure in COUNTS else 1e-3))
            for field in fields(Evidence)
            if getattr(part, field.name) != getattr(SOUND, field.name)
        }
        assert judge(replace(SOUND, **both)).outcome is one.outcome


def test_a_pose_that_landmarks_only_confirm_needs_no_matches_by_descriptors() -> None:
    refused = judge(replace(SOUND, log10_nfa=0.0))
    assert (refused.accepted, "1e+00 such poses are expected of an image of another place" in refused.reason) == (
        False,
        True,
    )
    assert judge(replace(SOUND, log10_nfa=0.0, searched=False)).accepted


# Confidence


def test_an_unlikely_answer_is_uncertain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_module("bidnerf_core.localization.accept"), "model", lambda: UNSURE)
    found = judge(SOUND)
    assert found.outcome is Outcome.UNCERTAIN
    assert found.confidence == pytest.approx(1 / (1 + math.e))
    assert f"{math.floor(100 * require(found.confidence))}%" in found.reason


BETTER: dict[str, list[float]] = {
    "inliers": [15, 50, 200, 1000],
    "by_chance": [60.0, 20.0, 5.0, 0.0],
    "recall": [0.05, 0.3, 0.8],
    "spread": [0.06, 0.3, 1.0],
    "noise_ratio": [3.0, 1.5, 1.0],
    "precision": [0.03, 0.01, 0.001],
    "mass": [0.8, 0.9, 0.999, 1.0],
    "replaced": [0.9, 0.3, 0.0],
    "on_surface": [0.1, 0.5, 0.9],
    "colour_inliers": [0.1, 0.3, 0.8],
}


@pytest.mark.parametrize("name", BETTER)
def test_better_evidence_moves_its_features_one_way_and_leaves_the_others(name: str) -> None:
    by_value = [features(replace(SOUND, **{name: value})) for value in BETTER[name]]
    changed = {key for key in by_value[0] if len({each[key] for each in by_value}) > 1}
    of_ratio = {"above_chance"} if name in ("inliers", "by_chance") else set()
    assert of_ratio <= changed <= {name} | of_ratio
    assert changed
    for key in changed:
        values = [each[key] for each in by_value]
        assert values in (sorted(values), sorted(values, reverse=True))


def test_the_probability_is_monotone_in_each_feature_and_never_fails() -> None:
    known = LogisticModel({"a": 2.0, "b": -3.0}, 0.5)
    for name, sign in (("a", 1), ("b", -1)):
        values = [known.probability({"a": 0.0, "b": 0.0} | {name: x}) for x in (-1e6, -1, 0, 1, 1e6)]
        assert values == sorted(values, reverse=sign < 0)
        assert 0 <= min(values) <= max(values) <= 1
    assert known.probability({"a": 0.0, "b": 0.0}) == pytest.approx(1 / (1 + math.exp(-0.5)))


def test_surfaces_that_were_not_measured_neither_support_nor_contradict() -> None:
    found = features(SOUND)
    assert (found["on_surface"], found["colour_inliers"]) == (0, 0)


def test_the_stored_model_has_a_weight_for_each_feature_and_levels_for_risks() -> None:
    stored = json.loads((files("bidnerf_core.localization") / "acceptance.json").read_text())
    known = LogisticModel(**stored["landmarks"])
    assert set(known.weights) <= set(features(SOUND))
    assert all(math.isfinite(weight) for weight in (*known.weights.values(), known.bias))
    risks, least = zip(*stored["risk"]["least_confidence"], strict=True)
    assert list(risks) == sorted(risks)
    assert list(least) == sorted(least, reverse=True)
    assert all(ACCEPTED <= confidence <= 1 for confidence in least)


# Risk


@pytest.fixture
def levels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(import_module("bidnerf_core.localization.accept"), "stored", lambda: LEVELS)


@pytest.mark.usefixtures("levels")
@pytest.mark.parametrize(("risk", "least"), [(0.01, 0.97), (0.03, 0.97), (0.05, 0.9), (0.07, 0.9), (0.1, 0.8)])
def test_the_largest_calibrated_risk_below_the_tolerated_one_counts(risk: float, least: float) -> None:
    assert least_confidence(risk) == least
    assert AutoConfig(risk=risk).risk == risk
    assert within_risk(replace(answer(confidence=least), diagnostics=SOUND), risk).converged
    unsure = within_risk(replace(answer(confidence=least - 0.001), diagnostics=SOUND), risk)
    assert unsure.outcome is Outcome.UNCERTAIN
    assert unsure.confidence == least - 0.001


@pytest.mark.usefixtures("levels")
def test_an_answer_without_landmarks_is_not_accepted_at_any_risk_and_a_rejection_stays_what_it_is() -> None:
    for found in (answer(), answer(confidence=0.99)):
        assert within_risk(found, 0.1).outcome is Outcome.UNCERTAIN
    found = answer(outcome=Outcome.MIRRORED, confidence=0.99)
    assert within_risk(found, 0.1) is found


@pytest.mark.usefixtures("levels")
@pytest.mark.parametrize("risk", [0.0, 0.009, 0.11, 1.0, -1.0, math.nan, math.inf, "0.05"])
def test_a_risk_that_was_not_calibrated_is_refused(risk: Any) -> None:
    is_number = isinstance(risk, float) and math.isfinite(risk)
    with refused(found=f"risk is {risk!r}", expected="0.01 to 0.1" if is_number else "float"):
        AutoConfig(risk=risk)


@pytest.mark.parametrize(("tolerance", "accepted"), [(0.05, True), (0.02, False), (None, True)])
def test_a_tolerance_rejects_what_is_less_certain(tolerance: float | None, accepted: bool) -> None:
    """A Gaussian of 0.015 along each axis has 99 % of its mass within 0.05, and 38 % within 0.02."""
    covariance = torch.diag(torch.tensor([0.015] * 3 + [0.001] * 3, dtype=torch.float64).square())
    found = within_limits(replace(answer(), covariance=covariance), AutoConfig(tolerance=tolerance))
    assert found.converged is accepted
    assert accepted or "within 0.02 with a probability of 3" in found.reason
    assert within_limits(answer(), AutoConfig(tolerance=tolerance)).converged is (tolerance is None)  # no covariance
