"""Answers in maps of photos from one place, which show directions and no distances."""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.localization.problem import SceneMap
from bidnerf_core.localization.result import Localization, Outcome

NO_DISTANCES = "the map's photos are from one place and show no distances"


def has_distances(scene: SceneMap) -> bool:
    """Return whether the images of a map showed how far things are; a map that does not say so is taken to know it."""
    return bool(getattr(scene, "has_distances", True))


def direction_only(found: Localization) -> Localization:
    """Return an answer that does not claim to know a position; one that was rejected for another reason stays so."""
    outcome = Outcome.IMPRECISE if found.converged else found.outcome
    return replace(
        found,
        outcome=outcome,
        reason=f"{NO_DISTANCES}, so the position is unknown and the direction alone may be right; {found.reason}",
        covariance=None,
        confidence=None,
    )
