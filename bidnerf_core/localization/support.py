"""Support of a pose found without landmarks: the measurements must agree with the pose and distinguish it from its rivals.

A plain wall looks the same from everywhere, so agreement alone is weak evidence: a pose must explain the measurements better
than its rivals. The rivals are poses displaced by more than the tolerated error, the best different pose of a search, and
images rendered in their mean colour. One test serves colours, depths and points on the surface: the difference of each
measurement's cost between the rival and the pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.accept import Bound
from bidnerf_core.localization.pivots import Pivot
from bidnerf_core.localization.result import Outcome, Verdict

DISPLACEMENT = 0.1
"""Displacement of rivals: a fraction of the distance to the scene, and an angle about it in radians.

It is three times the maximum standard deviation of an accepted position by landmarks.
"""
NO_RIVAL = 1000.0
"""Log odds against a rival that does not exist; finite, since records contain finite numbers."""
SUPPORT_BOUNDS = (
    Bound("mean_loss", 0.02, False, Outcome.HIGH_LOSS, "mean loss {0:.3g}, must be below {1:.3g}"),
    Bound("on_surface", 0.85, True, Outcome.OFF_SURFACE, "only {0:.0%} of the measured points lie on the surface"),
    Bound("colour_inliers", 0.42, True, Outcome.COLOUR_MISMATCH, "only {0:.0%} of the measured points have the surface's colour"),
    Bound("free_space_violations", 0.15, False, Outcome.FREE_SPACE_VIOLATED, "{0:.0%} of the lines of sight pass through the surface"),
    Bound("runner_up_margin", 0.15, True, Outcome.AMBIGUOUS, "another pose fits about as well"),
    Bound("rendered_inliers", 0.8, True, Outcome.RENDERING_MISMATCH, "only {0:.0%} of the rendered rays agree with the measurements"),
    # Of the answers on record, 16 of 17 right ones were more precise, and 2 of 15 wrong ones, most of them by another camera than stated.
    Bound("precision", 0.015, False, Outcome.IMPRECISE, "the position is uncertain by {0:.1%} of the distance"),
    Bound("determined", 1.0, True, Outcome.UNDETERMINED, "the measurements do not determine the pose"),
    Bound("new_inliers", 0.93, True, Outcome.RENDERING_MISMATCH, "{0:.0%} of newly drawn rays agree with the measurements, expected {1:.0%}"),
    Bound("confidence", 0.8, True, Outcome.UNDETERMINED, "{2} fits about as well"),
    Bound("explained", 0.5, True, Outcome.RENDERING_MISMATCH, "the pose explains only {0:.0%} of the contrast of the image"),
    # Right poses before a wall of weak texture, from twelve places, have steps of up to 0.018: the noise of the rays.
    Bound("further_step", 0.02, False, Outcome.NOT_SETTLED, "newly drawn rays give a further step of {0:.3g}, expected {1:g} at most"),
    # A wrong pose can be the best one far around, so that rivals nearby are no better, but its colours differ more. On test images of
    # Lego and the room, the ratio was 0.8 to 1.4 at right poses, and 2.1 and more at wrong ones.
    Bound("colour_ratio", 1.8, False, Outcome.RENDERING_MISMATCH, "the colours differ {0:.1f} times as much as in the map's own images"),
)  # fmt: skip
"""The bounds of a pose without landmarks, the most serious reason first."""


def odds(log_odds: float) -> float:
    """Return the odds for given log odds, limited to the range of floating-point numbers."""
    return math.exp(max(-500.0, min(500.0, log_odds)))


Costs = Callable[[SE3], Float[Tensor, "h n"]]
"""Returns each of n measurements' part of the cost, from each of h poses."""


@dataclass(frozen=True)
class Support:
    """How well measurements other than landmarks support a pose; None for what was not measured."""

    # Fraction of the contrast: 1 - the ratio of the cost to that of the mean colour
    explained: float | None = None
    # Log odds against rivals, ``NO_RIVAL`` if there is none:
    plain: float = NO_RIVAL  # the mean colour, unless more than colours is compared
    displaced: float | None = None  # the best of the displaced poses
    other: float = NO_RIVAL  # the best different pose of a search
    # Points on the surface; all but the margin are fractions.
    on_surface: float | None = None
    colour_inliers: float | None = None
    free_space_violations: float | None = None
    runner_up_margin: float | None = None  # by which the score of the best different pose is worse
    # Standard deviation of the position relative to the distance, without the sensor's scale and offset; in maps with landmarks.
    precision: float | None = None
    rendered_inliers: float | None = None  # of the rays to which the pose was fitted, too
    # Rays to which the pose was not fitted.
    determined: float | None = None  # 1 if they determine all six degrees of freedom, else 0
    new_inliers: float | None = None
    further_step: float | None = None  # of the scene relative to its distance, and radians
    colour_ratio: float | None = None  # of the differences to those of the map's own images
    mean_loss: float | None = None  # of the last steps of a first-order descent
    limits: dict[str, float] = field(default_factory=dict)  # other than the usual ones, by measure

    @property
    def confidence(self) -> float | None:
        """The posterior probability of the pose, with equal prior odds against each rival; None if it was not compared with rivals."""
        if self.displaced is None:
            return None
        return 1 / (1 + sum(odds(-against) for against in (self.plain, self.displaced, self.other)))

    def verdict(self, accepted: str) -> Verdict:
        """Return the verdict of the first violated bound or, if all bounds hold, acceptance with the reason ``accepted``."""
        displaced = NO_RIVAL if self.displaced is None else self.displaced
        rivals = (
            (self.plain, Outcome.UNDETERMINED, "a single-colour image"),
            (displaced, Outcome.UNDETERMINED, f"a pose displaced by {DISPLACEMENT:.0%} of the distance to the scene"),
            (self.other, Outcome.AMBIGUOUS, "another pose"),
        )  # fmt: skip
        for bound in SUPPORT_BOUNDS:
            value, limit = getattr(self, bound.measure), self.limits.get(bound.measure, bound.limit)
            if value is None or bound.keeps(value, limit):
                continue
            if bound.measure != "confidence":
                return Verdict(bound.outcome, bound.reason.format(value, limit))
            _, outcome, rival = min(rivals, key=lambda rival: rival[0])
            return Verdict(outcome, bound.reason.format(value, limit, rival), value)
        return Verdict(Outcome.CONVERGED, accepted, self.confidence)


def support(
    costs: Costs,
    T: SE3,
    middle: Float[Tensor, "3"],
    plain: Float[Tensor, "n"] | None = None,
    others: SE3 | None = None,
) -> Support:
    """Compare a pose with its rivals.

    ``middle`` is the middle of the visible scene (metres, last camera's frame), about which rivals are displaced. ``plain`` is
    each measurement's cost in images rendered in their mean colour; None if more than colours is compared. ``others`` are
    poses (h) found by a search; those within the displacement do not count as rivals.
    """
    here, about = costs(T[None])[0], Pivot.at_point(middle.to(T.translation))
    reach = float(torch.linalg.vector_norm(middle))
    # Twelve poses, displaced in both directions along and about each axis.
    size = torch.tensor([DISPLACEMENT * reach] * 3 + [DISPLACEMENT] * 3, dtype=torch.float64)
    steps = torch.cat([torch.diag(size), -torch.diag(size)]).to(T.translation)
    many = SE3(T.rotation.expand(12, 3, 3), T.translation.expand(12, 3))
    displaced, other = float(log_odds(costs(about.moved(many, steps)), here).min()), NO_RIVAL
    if others is not None and len((far := others[~same_pose(T, others, middle)]).translation):
        other = float(log_odds(costs(far), here).min())
    if plain is None:
        return Support(displaced=displaced, other=other)
    total = float(plain.sum())
    explained = max(0.0, 1 - float(here.sum()) / total) if total > 0 else 0.0
    return Support(explained, float(log_odds(plain[None], here)[0]), displaced, other)


def log_odds(rivals: Float[Tensor, "h n"], here: Float[Tensor, "n"]) -> Float[Tensor, "h"]:
    """Return the log odds of the pose against each rival, from the costs of each measurement for both; 0 where not finite."""
    difference = rivals - here
    error = difference.std(-1) * difference.shape[-1] ** 0.5
    # Half a unit of log odds per standard error of the difference: independent measurements would justify more, but the errors of
    # a field's rays are correlated. It was chosen on frames held out for tuning.
    odds = 0.5 * difference.sum(-1) / error.clamp(min=1e-12)
    return torch.where(odds.isfinite(), odds, 0)


def same_pose(
    T: SE3, others: SE3, middle: Float[Tensor, "3"], within: float = DISPLACEMENT
) -> Bool[Tensor, "h"]:
    """Return a mask of the ``others`` (h) that differ from ``T`` by at most ``within``.

    ``within`` limits both the displacement of the ``middle`` of the visible scene (metres, last camera's frame), as a fraction of the
    distance to the middle, and the angle in radians.
    """
    middle = middle.to(T.translation)
    shift = torch.linalg.vector_norm(others.apply(middle) - T.apply(middle), dim=-1)
    trace = (T.rotation.mT @ others.rotation).diagonal(dim1=-2, dim2=-1).sum(-1)
    return (shift <= within * torch.linalg.vector_norm(middle)) & (trace >= 1 + 2 * math.cos(within))
