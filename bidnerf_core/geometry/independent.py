"""How many independent measurements those of one image count as: the table of all kinds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Independent:
    """The most independent measurements that each kind amounts to in one image, however many are drawn.

    The errors of a map, a sensor and a lens are shared by large parts of an image. n measurements whose errors have the
    correlation r in pairs determine a mean as well as ``n / (1 + (n - 1) r)`` independent ones, and never as well as 1 / r; the
    denominator is the design effect (Kish, "Survey Sampling", 1965). The table holds 1 / r.
    """

    points: float = 10.0  # measured depth against the surface
    rays: float = 300.0  # colours against rendered ones, beside landmarks
    rays_alone: float = 10.0  # the same where they alone determine the pose, from a start that may be far off
    blurred: float = 60.0  # pixels of a small image against a rendering that is blurred to match
    # Points of a tracked frame beside landmarks: hand-held sensors err more than the figure for points says.
    tracked_points: float = 3.0


USUAL = Independent()
"""The figures of all maps: those that a map's own images show are too good, since its field was fitted to them."""
KEYPOINTS_PER_INDEPENDENT = 10.0
"""Number of keypoints that count as one measurement, where a map does not state its own: they are too few to tend to 1 / r."""
CORNERS_PER_INDEPENDENT = 4.0
"""Number of corners, followed from one frame to the next, that count as one measurement."""


def independent(drawn: float, most: float) -> float:
    """Return how many independent measurements ``drawn`` ones count as, of a kind that amounts to ``most``."""
    return drawn * most / (drawn + most - 1)
