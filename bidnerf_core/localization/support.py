"""Support of a pose: whether the measurements distinguish it from its rivals.

A plain wall looks the same from everywhere, so agreement alone is weak evidence: a pose must explain the measurements better
than its rivals. These are poses displaced from it by more than the tolerated error, the best different pose of a search, and
images rendered in their mean colour. One test serves colours, depths and points on the surface: the difference of each
measurement's cost between the rival and the pose.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.pivots import Pivot
from bidnerf_core.localization.result import Outcome, Verdict

DISTINGUISHED = 0.8
"""Least probability of a pose among its rivals."""
DISPLACEMENT = 0.1
"""Displacement of rivals: a fraction of the distance to the scene, and an angle about it in radians.

It is three times the maximum standard deviation of an accepted position by landmarks.
"""
LOG_ODDS_PER_DEVIATION = 0.5
"""Log odds per standard error of the difference between two costs.

Independent measurements would justify more, but the errors of a field's rays are correlated. Chosen on frames held out for
tuning.
"""
NO_RIVAL = 1000.0
"""Log odds against a rival that does not exist; finite, since records contain finite numbers."""
LEAST_EXPLAINED = 0.5
"""Minimum fraction of an image's contrast that an accepted pose explains."""


def odds(log_odds: float) -> float:
    """Return the odds of given logarithm, limited to what floating-point numbers can hold."""
    return math.exp(max(-500.0, min(500.0, log_odds)))


Costs = Callable[[SE3], Float[Tensor, "h n"]]
"""Returns each of n measurements' part of the cost, from each of h poses."""


@dataclass(frozen=True)
class Support:
    """How well measurements distinguish a pose from its rivals."""

    explained: float  # fraction of the images' contrast: 1 - the ratio of the cost to that of the mean colour
    plain: float  # log odds against the mean colour; ``NO_RIVAL`` if more than colours was compared
    displaced: float  # log odds against the best of the displaced poses
    other: float  # log odds against the best different pose of a search; ``NO_RIVAL`` if there was none

    @property
    def confidence(self) -> float:
        """The posterior probability of the pose, with equal prior odds against each rival."""
        return 1 / (1 + sum(odds(-against) for against in (self.plain, self.displaced, self.other)))

    def rejection(self, least_explained: float = LEAST_EXPLAINED) -> Verdict | None:
        """Return the reason why the measurements do not support the pose, or None."""
        p = self.confidence
        if p < DISTINGUISHED:
            if self.plain <= min(self.displaced, self.other):
                return Verdict(Outcome.UNDETERMINED, "a single-colour image fits about as well", p)
            if self.other < self.displaced:
                return Verdict(Outcome.AMBIGUOUS, "another pose fits about as well", p)
            share = f"{DISPLACEMENT:.0%} of the distance to the scene"
            return Verdict(Outcome.UNDETERMINED, f"poses displaced by {share} fit about as well", p)
        if not self.explained >= least_explained:
            share = f"{max(self.explained, 0):.0%} of the contrast of the image"
            return Verdict(Outcome.RENDERING_MISMATCH, f"the pose explains only {share}")
        return None


@dataclass(frozen=True)
class DescentDiagnostics:
    """The measures by which the answer of a first-order descent is judged."""

    mean_loss: float  # of its last steps
    converged_loss: float  # below which it is accepted
    support: Support


@dataclass(frozen=True)
class SurfaceThresholds:
    """Thresholds for accepting a pose on the baked surface."""

    on_surface: float = 0.85  # minimum fraction of the measured points on the surface
    colour_inliers: float = 0.42  # minimum fraction of the measured points on the surface and with its colour
    free_space_violations: float = 0.15  # maximum fraction of lines of sight that pass through the surface
    runner_up_margin: float = 0.15  # margin by which the second-best pose must be worse
    rendered_inliers: float = 0.8  # minimum inlier fraction of the rendered rays


@dataclass(frozen=True)
class SurfaceDiagnostics:
    """Measures of how well a pose explains the measured points; all but the margin are fractions between 0 and 1."""

    on_surface: float
    colour_inliers: float
    free_space_violations: float
    runner_up_margin: float
    rendered_inliers: float = 1.0  # 1 if nothing was rendered
    support: Support | None = None  # None: not compared with other poses

    def rejection(self, thresholds: SurfaceThresholds = SurfaceThresholds()) -> Verdict | None:
        """Return the most serious reason to reject the pose, or None."""
        if not self.on_surface >= thresholds.on_surface:
            return Verdict(
                Outcome.OFF_SURFACE, f"only {self.on_surface:.0%} of the measured points lie on the surface"
            )
        if not self.colour_inliers >= thresholds.colour_inliers:
            share = f"{self.colour_inliers:.0%} of the measured points have the surface's colour"
            return Verdict(Outcome.COLOUR_MISMATCH, f"only {share}")
        if not self.free_space_violations <= thresholds.free_space_violations:
            share = f"{self.free_space_violations:.0%} of the lines of sight"
            return Verdict(Outcome.FREE_SPACE_VIOLATED, f"{share} pass through the surface")
        if not self.runner_up_margin >= thresholds.runner_up_margin:
            return Verdict(Outcome.AMBIGUOUS, "another pose fits about as well")
        if not self.rendered_inliers >= thresholds.rendered_inliers:
            share = f"{self.rendered_inliers:.0%} of the rendered rays agree with the measurements"
            return Verdict(Outcome.RENDERING_MISMATCH, f"only {share}")
        return None if self.support is None else self.support.rejection()

    def verdict(self, thresholds: SurfaceThresholds = SurfaceThresholds()) -> Verdict:
        share = f"{self.colour_inliers:.0%} of the measured points match the surface in position and colour"
        confidence = None if self.support is None else self.support.confidence
        return self.rejection(thresholds) or Verdict(Outcome.CONVERGED, share, confidence)


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
    near = log_odds(costs(about.moved(many, steps)), here)
    far = near[:0]
    if others is not None:
        others = others[~same_pose(T, others, middle)]
        far = log_odds(costs(others), here) if len(others.translation) else far
    explained, by_plain = 1.0, NO_RIVAL
    if plain is not None:
        total = float(plain.sum())
        explained = 1 - float(here.sum()) / total if total > 0 else 0.0
        by_plain = float(log_odds(plain[None], here)[0])
    return Support(explained, by_plain, float(near.min()), float(far.min()) if len(far) else NO_RIVAL)


def log_odds(rivals: Float[Tensor, "h n"], here: Float[Tensor, "n"]) -> Float[Tensor, "h"]:
    """Return the log odds against each rival, from the costs of each measurement for it and the pose; 0 where not finite."""
    difference = rivals - here
    error = difference.std(-1) * difference.shape[-1] ** 0.5
    odds = LOG_ODDS_PER_DEVIATION * difference.sum(-1) / error.clamp(min=1e-12)
    return torch.where(odds.isfinite(), odds, 0)


def same_pose(
    T: SE3, others: SE3, middle: Float[Tensor, "3"], within: float = DISPLACEMENT
) -> Bool[Tensor, "h"]:
    """Return a mask of the ``others`` (h) that differ from ``T`` by at most ``within``.

    This is a fraction of the distance to the ``middle`` of the visible scene (metres, last camera's frame), by which the middle is
    displaced, and an angle in radians.
    """
    middle = middle.to(T.translation)
    shift = torch.linalg.vector_norm(others.apply(middle) - T.apply(middle), dim=-1)
    trace = (T.rotation.mT @ others.rotation).diagonal(dim1=-2, dim2=-1).sum(-1)
    return (shift <= within * torch.linalg.vector_norm(middle)) & (trace >= 1 + 2 * math.cos(within))
