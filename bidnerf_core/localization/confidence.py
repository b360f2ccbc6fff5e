"""Confidence in a pose by landmarks: the probability that it is right, by a logistic model of its diagnostics.

The weights were learned by ``benchmarks/confidence.py`` from answers to images with and without faults; ``confidence.json``
holds them. Poses found by other means are compared with rivals instead: ``Support.confidence``.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files

from bidnerf_core.localization.acceptance import LandmarkDiagnostics
from bidnerf_core.localization.landmarks.chance import probability_of
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.support import ACCEPTED

TRUSTED = 0.95
"""Minimum confidence at which a pose by landmarks is trusted without further measurements."""


@dataclass(frozen=True)
class LogisticModel:
    """A logistic regression (Cox 1958): the logarithm of the odds is linear in the features."""

    features: tuple[str, ...]
    weights: tuple[float, ...]
    bias: float

    def probability(self, values: dict[str, float]) -> float:
        """Return the probability for features by name."""
        terms = (w * values[name] for name, w in zip(self.features, self.weights, strict=True))
        return probability_of(self.bias + sum(terms))


def judged(verdict: Verdict, diagnostics: LandmarkDiagnostics) -> Verdict:
    """Return the verdict with the confidence in the pose, which can turn it into a rejection."""
    value = model().probability(landmark_features(diagnostics))
    if verdict.accepted and value < ACCEPTED:
        percent = math.floor(100 * value)
        verdict = Verdict(Outcome.UNCERTAIN, f"only {percent}% likely to be right; {verdict.reason}")
    return replace(verdict, confidence=value)


@lru_cache(maxsize=1)
def model() -> LogisticModel:
    """Return the stored model."""
    stored = json.loads((files(__package__) / "confidence.json").read_text())["models"]["landmarks"]
    return LogisticModel(tuple(stored["features"]), tuple(stored["weights"]), stored["bias"])


def landmark_features(found: LandmarkDiagnostics) -> dict[str, float]:
    """Return the features of a pose by landmarks; none depends on the unit of length or the image's size."""
    possible = min(found.visible, found.keypoints)
    return {
        "inliers": math.log10(1 + found.inliers),
        "above_chance": math.log10((1 + found.inliers) / (1 + found.chance)),
        "recall": math.log10((1 + found.inliers) / (1 + possible)),
        "noise_ratio": math.log10(max(found.noise_ratio, 0.1)),
        "agreement": found.agreeing / max(found.matches, 1),
        "spread": found.spread,
        "precision": math.log10(min(max(found.precision, 1e-4), 1.0)),
        "miscalibration": found.miscalibration,
        "estimated_calibration": float(found.estimated_calibration),
        "confirmed_only": 0.0 if found.searched else 1.0,
        # Without measured points, the surface neither supports nor contradicts a pose.
        "on_surface": 0.0 if found.on_surface is None else found.on_surface - 0.5,
        "colour_inliers": 0.0 if found.colour_inliers is None else found.colour_inliers - 0.25,
    }
