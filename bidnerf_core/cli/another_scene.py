"""Whether images show another scene than that of the map, by what became of all of them."""

from __future__ import annotations

from collections.abc import Collection

from bidnerf_core.localization import Outcome

RECOGNISED = {
    Outcome.CONVERGED, Outcome.IMPRECISE, Outcome.MIRRORED, Outcome.MISCALIBRATED, Outcome.UNCERTAIN
}  # fmt: skip
"""Outcomes of images that show the scene."""
SEVERAL = 3
"""Least number of images that all have to be rejected for the map to be doubted."""


def doubt(outcomes: Collection[Outcome]) -> str:
    """Return a question to add to a summary if several images were all rejected, and none as one that shows the scene."""
    if len(outcomes) < SEVERAL or RECOGNISED.intersection(outcomes):
        return ""
    return "; do they show the scene of this map?"
