"""Whether images show another scene than that of the map, by what became of all of them."""

from __future__ import annotations

from collections.abc import Collection

from bidnerf_core.localization import Localization, Outcome
from bidnerf_core.localization.acceptance import LandmarkDiagnostics, LandmarkThresholds

RECOGNISED = {
    Outcome.CONVERGED, Outcome.IMPRECISE, Outcome.MIRRORED, Outcome.MISCALIBRATED, Outcome.UNCERTAIN
}  # fmt: skip
"""Outcomes of images that show the scene."""
SEVERAL = 3
"""Least number of images that all have to be rejected for the map to be doubted."""


def question_about_scene(answers: Collection[Localization]) -> str:
    """Return a question to add to a summary if several images were all rejected, and none as one that shows the scene."""
    if len(answers) < SEVERAL or any(map(_shows_scene, answers)):
        return ""
    return "; do they show the scene of this map?"


def _shows_scene(answer: Localization) -> bool:
    """Whether an image was recognised; one that is ambiguous was, if far more landmarks agree with its pose than by chance."""
    found = answer.diagnostics
    if answer.outcome is Outcome.AMBIGUOUS and isinstance(found, LandmarkDiagnostics):
        return found.inliers >= LandmarkThresholds().above_chance * found.chance
    return answer.outcome in RECOGNISED
