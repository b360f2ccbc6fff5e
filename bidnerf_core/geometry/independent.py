"""Effective number of independent measurements per image, for every kind of measurement."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Independent:
    """Upper bound on the independent measurements of each kind in one image, however many are sampled.

    The errors of a map, a sensor and a lens are shared by large parts of an image. n measurements whose
    errors have pairwise correlation r determine a mean as well as ``n / (1 + (n - 1) r)`` independent ones,
    and never better than 1 / r; the denominator is the design effect (Kish, "Survey Sampling", 1965). The
    table holds 1 / r.
    """

    points: float = 10.0  # measured depth against the surface
    rays: float = 300.0  # rendered against measured colours, alongside landmarks
    rays_alone: float = 10.0  # likewise, but alone, from a start that may be far off
    blurred: float = 60.0  # pixels of a small image against a rendering blurred to match
    # Points of a tracked frame alongside landmarks: hand-held sensors err more than the figure for points
    # suggests.
    tracked_points: float = 3.0


USUAL = Independent()
"""The figures used for all maps: those measured on a map's own images are too optimistic, since its field was
fitted to them."""
KEYPOINTS_PER_INDEPENDENT = 10.0
"""Number of keypoints that count as one measurement if a map does not state its own: they are too few to
approach 1 / r."""
CORNERS_PER_INDEPENDENT = 4.0
"""Number of corners tracked between frames that count as one measurement."""


def independent(drawn: float, most: float) -> float:
    """Return the effective number of independent measurements among ``drawn`` ones of a kind limited to
    ``most``.
    """
    return drawn * most / (drawn + most - 1)
