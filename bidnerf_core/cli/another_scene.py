"""The suspicion that images show a scene other than that of the map, from the outcomes of all of them."""

from __future__ import annotations

from collections.abc import Collection

from bidnerf_core.localization import Localization, Outcome
from bidnerf_core.localization.acceptance import LandmarkDiagnostics, LandmarkThresholds

RECOGNISED = {
    Outcome.CONVERGED, Outcome.IMPRECISE, Outcome.MIRRORED, Outcome.MISCALIBRATED, Outcome.UNCERTAIN
}  # fmt: skip
"""Outcomes of images that show the scene."""
SEVERAL = 3
"""Minimum number of images, all of them rejected, at which the user is asked whether the map is the right one."""


def question_about_scene(answers: Collection[Localization]) -> str:
    """Return a question to append to a summary: empty unless there are several images and none was recognised."""
    if len(answers) < SEVERAL or any(map(_shows_scene, answers)):
        return ""
    return "; do they show the scene of this map?"


def _shows_scene(answer: Localization) -> bool:
    """Return whether an image was recognised. An ambiguous one counts if far more landmarks fit its pose than by chance."""
    found = answer.diagnostics
    if answer.outcome is Outcome.AMBIGUOUS and isinstance(found, LandmarkDiagnostics):
        return found.inliers >= LandmarkThresholds().above_chance * found.chance
    return answer.outcome in RECOGNISED
