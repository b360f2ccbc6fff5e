"""Answers in maps of photos from one place, which determine directions but not distances."""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.localization.result import Localization, Outcome

NO_DISTANCES = "the map's photos are from one place and show no distances"


def direction_only(found: Localization) -> Localization:
    """Reject an answer, as its position is unknown: as imprecise, or for its own reason if it was already rejected."""
    outcome = Outcome.IMPRECISE if found.converged else found.outcome
    return replace(
        found,
        outcome=outcome,
        reason=f"{NO_DISTANCES}, so the position is unknown and only the direction may be right; {found.reason}",
        covariance=None,
        confidence=None,
    )
