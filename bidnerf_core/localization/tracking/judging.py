"""Judgements of a tracked pose that go beyond those of a single image."""

from __future__ import annotations

import math

from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.acceptance import LandmarkThresholds
from bidnerf_core.localization.by_colour import TYPICAL_ERRORS
from bidnerf_core.localization.covariance import position_deviation
from bidnerf_core.localization.result import Outcome, Verdict

DETERMINED = 0.02, math.radians(3)
"""Largest standard deviations of an accepted pose by depth or colour: share of the scene's extent, and radians."""


def not_by_chance(verdict: Verdict, noise: float, threshold: float) -> Verdict:
    """Return the verdict on followed landmarks, or a rejection if their ``noise`` (pixels) is what chance would give.

    Points spread evenly over a disc of radius ``threshold`` (pixels) have a standard deviation of half that radius along each
    axis. Where the flow has gone astray over a long interval, the landmarks agree no better than that.
    """
    if not verdict.accepted or noise <= threshold / 2:
        return verdict
    return Verdict(Outcome.AMBIGUOUS, f"{verdict.reason}, hardly better than by chance")


def unconfirmed(verdict: Verdict) -> Verdict:
    """Reject a pose by few followed landmarks where none are recognised around it: it may have drifted away."""
    if not verdict.accepted:
        return verdict
    return Verdict(
        Outcome.TOO_FEW_MATCHES,
        f"{verdict.reason}, but the image does not confirm these few that were followed",
    )


def precise_enough(verdict: Verdict, covariance: Float[Tensor, "6 6"], distance: float) -> Verdict:
    """Return the verdict, or a rejection if the position is too uncertain for the ``distance`` (metres) of what is in view."""
    deviation = position_deviation(covariance)
    if not verdict.accepted or deviation <= LandmarkThresholds().precision * distance:
        return verdict
    why = f"but the position is uncertain by {deviation / distance:.1%} of the distance"
    return Verdict(Outcome.IMPRECISE, f"{verdict.reason}, {why}")


def determined(verdict: Verdict, covariance: Float[Tensor, "6 6"], extent: float) -> Verdict:
    """Return the verdict, or a rejection if the pose's covariance is large for a scene of this ``extent`` (metres)."""
    translation, rotation = (float(part.max().sqrt()) for part in covariance.diagonal().split(3))
    if not verdict.accepted or (translation <= DETERMINED[0] * extent and rotation <= DETERMINED[1]):
        return verdict
    why = f"one standard deviation is {translation:.3g} m and {math.degrees(rotation):.2g} deg"
    return Verdict(Outcome.UNDETERMINED, why)


def as_certain_as_usual(verdict: Verdict, covariance: Float[Tensor, "6 6"], typical: float) -> Verdict:
    """Return the verdict, or a rejection if the position is far less certain than those of the map's own images.

    ``typical`` is their median error, metres; 0 where it is not known. Frames without colours are judged by it: along a
    corridor, nothing in them shows the position, which is then predicted rather than measured.
    """
    deviation = position_deviation(covariance)
    if not verdict.accepted or typical <= 0 or deviation <= TYPICAL_ERRORS * typical:
        return verdict
    why = f"but the position is uncertain by {deviation:.3g} m, that of images by {typical:.3g} m"
    return Verdict(Outcome.IMPRECISE, f"{verdict.reason}, {why}")


def shape_verdict(
    verdict: Verdict, covariance: Float[Tensor, "6 6"], distance: float, typical: float, stamped: bool
) -> Verdict:
    """Judge a pose by depth without colours, which relies on the motion before it as well.

    Without a time stamp, nothing determines how far the camera has moved in the directions that the shape leaves open.
    """
    if verdict.accepted and not stamped:
        return Verdict(
            Outcome.IMPRECISE, f"{verdict.reason}, but without a time stamp the motion is not known"
        )
    return as_certain_as_usual(precise_enough(verdict, covariance, distance), covariance, typical)
