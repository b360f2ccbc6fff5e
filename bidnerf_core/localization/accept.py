"""Acceptance of landmark-based poses: the evidence, a table of bounds and a logistic model."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import NamedTuple

from bidnerf_core.errors import InputError
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.settings import Range

ACCEPTED = 0.4
"""Minimum confidence of an accepted pose by landmarks.

It was lowered from 0.5 because right poses in small synthetic scenes had confidences of 0.39 to 0.46. More than a third of the
answers that the model was fitted to show falsified cameras, which may be why; no separate record supports this value.
"""


@dataclass(frozen=True)
class Evidence:
    """The evidence for accepting a landmark-based pose; no value depends on the unit of length or the image size."""

    # false alarms of the matches by descriptors alone; 0 if the pose was found by other means
    log10_nfa: float
    inliers: int  # matches by projection within three standard deviations
    by_chance: float  # such matches expected at a wrong pose
    recall: float  # fraction of the landmarks in view, or of the keypoints, that match
    spread: float  # fraction of the image's cells that contain a match
    noise_ratio: float  # keypoints' noise relative to that of the map's images
    other_place: float  # probability of another place or of a mirrored image
    credible: float  # probability of the explanations of the camera under which a pose counts as right
    replaced: float  # probability that neither the stated camera nor the map's is even approximately right
    precision: float  # standard deviation of the position relative to the scene's distance
    mass: float  # probability that the pose is within the tolerance, and its camera credible
    searched: bool  # whether landmarks found the pose, or only confirm one found by other means
    on_surface: float | None = None  # fraction of the measured points on the surface
    colour_inliers: float | None = None  # fraction of the measured points on the surface and with its colour

    @property
    def above_chance(self) -> float:
        """Ratio of the number of inliers to the number expected at a wrong pose, with one added to both."""
        return (1 + self.inliers) / (1 + self.by_chance)


class Bound(NamedTuple):
    """A limit on one measure, with the outcome and the reason to report if the measure violates it."""

    measure: str
    limit: float
    is_least: bool
    outcome: Outcome
    reason: str  # with the value as ``{0}``, and the limit as ``{1}``

    def keeps(self, value: float, limit: float) -> bool:
        """Return whether a value satisfies the ``limit``; NaN never does."""
        return value >= limit if self.is_least else value <= limit


LANDMARK_BOUNDS = (
    Bound("log10_nfa", -12.0, False, Outcome.TOO_FEW_MATCHES, "{0:.0e} poses as good are expected by chance"),
    Bound("inliers", 15, True, Outcome.TOO_FEW_MATCHES, "only {0:.0f} landmark inliers"),
    Bound("above_chance", 3.0, True, Outcome.AMBIGUOUS, "only {0:.1f} times as many landmarks match as by chance"),
    Bound("spread", 0.06, True, Outcome.UNDETERMINED, "the landmarks are all in {0:.0%} of the image"),
    Bound("other_place", 0.02, False, Outcome.AMBIGUOUS, "another place fits with a probability of {0:.0%}"),
    Bound("credible", 0.5, True, Outcome.MISCALIBRATED, "the image contradicts the intrinsics: they are right with {0:.0%}"),
    Bound("precision", 0.03, False, Outcome.IMPRECISE, "the position is uncertain by {0:.1%} of the distance"),
    Bound("mass", 0.8, True, Outcome.UNCERTAIN, "the pose is within the tolerance with a probability of {0:.0%}"),
)  # fmt: skip
"""The bounds of a pose by landmarks, the most serious reason first; the first does not apply to one that was found by other means."""


def judge(evidence: Evidence, log_odds: float = 0.0) -> Verdict:
    """Return the verdict of the first violated bound or, if all bounds hold, of the logistic model.

    ``log_odds`` are the prior log odds of the pose before its image was seen, relative to an image that may have been taken anywhere.
    """
    confidence = model().probability(features(evidence), log_odds)
    for bound in LANDMARK_BOUNDS if evidence.searched else LANDMARK_BOUNDS[1:]:
        value = getattr(evidence, bound.measure)
        if not bound.keeps(value, bound.limit):
            shown = 10.0 ** min(max(value, -300), 300) if bound.measure == "log10_nfa" else value
            return Verdict(bound.outcome, bound.reason.format(shown), confidence)
    share = f"{evidence.inliers} landmark inliers"
    if confidence < ACCEPTED:
        why = f"{share}, but only {math.floor(100 * confidence)}% likely to be right"
        return Verdict(Outcome.UNCERTAIN, why, confidence)
    return Verdict(Outcome.CONVERGED, share, confidence)


def features(found: Evidence) -> dict[str, float]:
    """Return the input features of the logistic model by name."""
    return {
        "inliers": math.log10(1 + found.inliers),
        "above_chance": math.log10(found.above_chance),
        "recall": math.log10(max(found.recall, 1e-3)),
        "noise_ratio": math.log10(max(found.noise_ratio, 0.1)),
        "spread": found.spread,
        "precision": math.log10(min(max(found.precision, 1e-4), 1.0)),
        "mass": -math.log10(max(1 - found.mass, 1e-4)),
        "replaced": found.replaced,
        "confirmed_only": 0.0 if found.searched else 1.0,
        # Without measured points, the surface neither supports nor contradicts a pose.
        "on_surface": 0.0 if found.on_surface is None else found.on_surface - 0.5,
        "colour_inliers": 0.0 if found.colour_inliers is None else found.colour_inliers - 0.25,
    }


@dataclass(frozen=True)
class LogisticModel:
    """A logistic regression (Cox 1958): the logarithm of the odds is linear in the features."""

    weights: dict[str, float]
    bias: float

    def probability(self, values: dict[str, float], prior: float = 0.0) -> float:
        """Return the probability for the named feature values; ``prior`` is added to the log odds."""
        log_odds = prior + self.bias + sum(weight * values[name] for name, weight in self.weights.items())
        return 1 / (1 + math.exp(-min(max(log_odds, -500), 500)))


@lru_cache(maxsize=1)
def stored() -> dict[str, dict[str, object]]:
    """Return the model and the calibrated risks, fitted by ``benchmarks/confidence.py`` and ``benchmarks/risk.py``."""
    found: dict[str, dict[str, object]] = json.loads((files(__package__) / "acceptance.json").read_text())
    return found


@lru_cache(maxsize=1)
def model() -> LogisticModel:
    """Return the logistic model for landmark-based poses."""
    return LogisticModel(**stored()["landmarks"])  # type: ignore[arg-type]


def least_confidence(risk: float) -> float:
    """Return the confidence required by the largest calibrated risk that does not exceed ``risk``.

    Raises ``InputError`` for a risk outside the calibrated range.
    """
    levels: list[tuple[float, float]] = stored()["risk"]["least_confidence"]  # type: ignore[assignment]
    calibrated = Range(levels[0][0], levels[-1][0])
    if risk not in calibrated:
        raise InputError(
            f"risk is {risk!r}", expected=f"{calibrated}, for which the confidence was calibrated"
        )
    return min(confidence for level, confidence in levels if level <= risk)
