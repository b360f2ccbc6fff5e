"""Acceptance of poses: the evidence for a pose, the bounds on it, and the confidence.

The confidence of a landmark-based pose comes from a logistic model of its evidence. Without landmarks, agreement alone is weak evidence, as
a plain wall looks the same from everywhere: a pose must explain the measurements better than its rivals, which are poses displaced by more
than the tolerated error, the best different pose of a search, and images rendered in their mean colour. Colours, depths and points on the
surface share one test: how much more each measurement costs at the rival than at the pose.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.resources import files
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.settings import Range

ACCEPTED = 0.8
"""Minimum confidence at which a pose is accepted.

In scenes other than those that the confidence was fitted to (``confidence``), 18 of 580 poses above it are wrong without any other bound.
"""


@dataclass(frozen=True)
class Evidence:
    """The evidence for accepting a landmark-based pose; no value depends on the unit of length or the image size."""

    # log10 of the number of false alarms of the matches by descriptors alone; 0 if the pose was found by other means
    log10_nfa: float
    inliers: int  # matches by projection within three standard deviations
    by_chance: float  # number of such matches expected at a wrong pose
    recall: float  # fraction of the landmarks in view, or of the keypoints if they are fewer, that match
    spread: float  # fraction of the image's cells that contain a match
    noise_ratio: float  # keypoints' noise relative to that of the map's images
    other_place: float  # probability of another place or of a mirrored image
    credible: float  # probability of the explanations of the camera under which a pose counts as right
    replaced: float  # probability that neither the stated camera nor the map's is even approximately right
    precision: float  # standard deviation of the position relative to the scene's distance
    mass: float  # probability that the pose is within the tolerance, and its camera credible
    searched: bool  # whether the pose was found by landmarks, not only confirmed by them
    mirrored: bool | None = None  # true if the mirror image was localized
    other_view: float | None = None  # number of other keypoints of the image that match from another pose
    on_surface: float | None = None  # fraction of the measured points on the surface
    colour_inliers: float | None = None  # fraction of the measured points on the surface and with its colour
    # mean robust loss of the rays relative to the usual one of the map's own images; None if no rays were rendered
    difference: float | None = None

    @property
    def above_chance(self) -> float:
        """Ratio of the number of inliers to the number expected at a wrong pose, with one added to both."""
        return (1 + self.inliers) / (1 + self.by_chance)

    @property
    def bounds(self) -> Iterator[tuple[Bound, float]]:
        """The bounds of ``LANDMARK_BOUNDS`` on the measures that were taken, each paired with the value of its measure."""
        for bound in LANDMARK_BOUNDS if self.searched else LANDMARK_BOUNDS[1:]:
            if self.difference is not None and bound.with_rays is not None:
                bound = bound._replace(limit=bound.with_rays)
            if (value := getattr(self, bound.measure)) is not None:
                yield bound, value

    @property
    def violated(self) -> list[tuple[Bound, float]]:
        """The bounds that the evidence violates, the most serious first."""
        return [(bound, value) for bound, value in self.bounds if not bound.keeps(value)]

    @property
    def is_open(self) -> bool:
        """Whether the verdict depends on measures that rendered rays may change."""
        return all(bound.is_open for bound, _ in self.violated)


class Bound(NamedTuple):
    """A limit on one measure, with the outcome and the reason to report if the measure violates it."""

    measure: str
    limit: float
    is_least: bool
    outcome: Outcome
    reason: str  # with the value as ``{0}``, and the limit as ``{1}``
    is_open: bool = False  # whether rendered rays may change the measure
    # the limit if rays were rendered, which confirm or contradict what the measure shows
    with_rays: float | None = None

    def keeps(self, value: float) -> bool:
        """Return whether a value satisfies the limit; NaN never does."""
        return value >= self.limit if self.is_least else value <= self.limit


LANDMARK_BOUNDS = (
    Bound(
        "log10_nfa",
        -12.0,
        False,
        Outcome.TOO_FEW_MATCHES,
        "so few landmarks agree that it may be by chance: {0:.0e} such poses are expected of an image of another place, at most"
        " {1:.0e} are accepted",
    ),
    Bound("inliers", 15, True, Outcome.TOO_FEW_MATCHES, "only {0:.0f} landmark inliers, expected {1:g}", True, 10),
    Bound("mirrored", 0, False, Outcome.MIRRORED, "the mirror image fits the map better than the image", True),
    Bound(
        "above_chance",
        3.0,
        True,
        Outcome.AMBIGUOUS,
        "only {0:.1f} times as many landmarks match as by chance, expected {1:g} times",
    ),
    Bound("spread", 0.06, True, Outcome.UNDETERMINED, "the landmarks are all in {0:.0%} of the image"),
    Bound(
        "other_view",
        0,
        False,
        Outcome.AMBIGUOUS,
        "the image shows two views: {0:.0f} other keypoints match from another pose",
    ),
    Bound("other_place", 0.02, False, Outcome.AMBIGUOUS, "another place fits with a probability of {0:.0%}", True),
    Bound(
        "credible",
        0.5,
        True,
        Outcome.MISCALIBRATED,
        "the image contradicts the stated intrinsics, which are right with a probability of {0:.0%}",
    ),
    Bound("precision", 0.03, False, Outcome.IMPRECISE, "the position is uncertain by {0:.1%} of the distance", True),
    # Chosen on the answers of Lego's maps on record (``answers_halves``, ``answers_unchanged``): of those that no other bound refuses, none
    # of the wrong ones differs by 1.4 to 2.4. Between 1.6 and 2.0, 7 answers in maps of Mic and the room are right, none is wrong.
    Bound(
        "difference",
        2.0,
        False,
        Outcome.RENDERING_MISMATCH,
        "the image differs {0:.1f} times as much from its rendering as the map's own images",
        True,
    ),
    Bound("mass", 0.8, True, Outcome.UNCERTAIN, "the pose is within the tolerance with a probability of {0:.0%}", True),
)
"""Bounds on the evidence for a landmark-based pose, most serious first. The first bound does not apply to a pose found by other means."""


def keeps_bound(measure: str, value: float) -> bool:
    """Return whether a value satisfies the bound on a measure of landmark-based poses."""
    return next(bound for bound in LANDMARK_BOUNDS if bound.measure == measure).keeps(value)


def judge(evidence: Evidence, log_odds: float = 0.0) -> Verdict:
    """Return the verdict on a landmark-based pose: that of the first violated bound or, if all bounds hold, that of the logistic model.

    ``log_odds`` are the prior log odds of the pose, relative to those of an image that may have been taken anywhere.
    """
    confidence = model().probability(features(evidence), log_odds)
    for bound, value in evidence.violated:
        shown = [10.0 ** min(max(x, -300), 300) if bound.measure == "log10_nfa" else x for x in (value, bound.limit)]
        return Verdict(bound.outcome, bound.reason.format(*shown), confidence)
    share = f"{evidence.inliers} landmark inliers"
    if confidence < ACCEPTED:
        why = f"{share}, but only {math.floor(100 * confidence)}% likely to be right"
        return Verdict(Outcome.UNCERTAIN, why, confidence)
    return Verdict(Outcome.CONVERGED, share, confidence)


def features(found: Evidence) -> dict[str, float]:
    """Return the input features of the logistic model by name."""
    return {
        "inliers": math.log10(1 + found.inliers),
        "above_chance": math.log10(found.above_chance),
        "recall": math.log10(max(found.recall, 1e-3)),
        "noise_ratio": math.log10(max(found.noise_ratio, 0.1)),
        "spread": found.spread,
        "precision": math.log10(min(max(found.precision, 1e-4), 1.0)),
        "mass": -math.log10(max(1 - found.mass, 1e-4)),
        "replaced": found.replaced,
        "confirmed_only": 0.0 if found.searched else 1.0,
        # Without measured points, the surface neither supports nor contradicts a pose.
        "on_surface": 0.0 if found.on_surface is None else found.on_surface - 0.5,
        "colour_inliers": 0.0 if found.colour_inliers is None else found.colour_inliers - 0.25,
    }


@dataclass(frozen=True)
class LogisticModel:
    """A logistic regression (Cox 1958): the logarithm of the odds is linear in the features."""

    weights: dict[str, float]
    bias: float

    def probability(self, values: dict[str, float], prior: float = 0.0) -> float:
        """Return the probability for the named feature values; ``prior`` is added to the log odds."""
        log_odds = prior + self.bias + sum(weight * values[name] for name, weight in self.weights.items())
        return 1 / (1 + math.exp(-min(max(log_odds, -500), 500)))


@lru_cache(maxsize=1)
def stored() -> dict[str, dict[str, object]]:
    """Return the parameters of the model and the calibrated risks, fitted by ``benchmarks/confidence.py`` and ``benchmarks/risk.py``."""
    found: dict[str, dict[str, object]] = json.loads((files(__package__) / "acceptance.json").read_text())
    return found


@lru_cache(maxsize=1)
def model() -> LogisticModel:
    """Return the logistic model for landmark-based poses."""
    return LogisticModel(**stored()["landmarks"])  # type: ignore[arg-type]


def least_confidence(risk: float) -> float:
    """Return the minimum confidence of accepted answers for a tolerated fraction ``risk`` of wrong ones.

    It is the confidence calibrated for the largest risk that does not exceed ``risk``. Raises ``InputError`` for a risk outside the
    calibrated range.
    """
    levels: list[tuple[float, float]] = stored()["risk"]["least_confidence"]  # type: ignore[assignment]
    calibrated = Range(levels[0][0], levels[-1][0])
    if risk not in calibrated:
        raise InputError(f"risk is {risk!r}", expected=f"{calibrated}, for which the confidence was calibrated")
    return min(confidence for level, confidence in levels if level <= risk)


DISPLACEMENT = 0.1
"""Displacement of rivals along each axis, as a fraction of the distance to the scene, and about each axis, in radians.

It is about three times the largest standard deviation of position, relative to that distance, at which a landmark-based pose is accepted.
"""
SUPPORT_BOUNDS = (
    Bound("finite", 1.0, True, Outcome.DIVERGED, "the loss or the pose is not finite"),
    Bound("mean_loss", 0.02, False, Outcome.HIGH_LOSS, "mean loss {0:.3g}, must be below {1:.3g}"),
    Bound("on_surface", 0.85, True, Outcome.OFF_SURFACE, "only {0:.0%} of the measured points lie on the surface"),
    Bound(
        "colour_inliers",
        0.42,
        True,
        Outcome.COLOUR_MISMATCH,
        "only {0:.0%} of the measured points have the surface's colour",
    ),
    Bound(
        "free_space_violations",
        0.15,
        False,
        Outcome.FREE_SPACE_VIOLATED,
        "{0:.0%} of the lines of sight pass through the surface",
    ),
    # A search by images ends where less of a small image agrees. Of 45 images of five scenes whose poses were accepted, at most 27 %
    # disagreed in any stage with steps; of 24 images of other scenes, at least 35 % in the last one.
    Bound(
        "image_inliers",
        0.7,
        True,
        Outcome.RENDERING_MISMATCH,
        "at best {0:.0%} of the image agree with the surface in a small size, expected {1:.0%}",
    ),
    Bound("runner_up_margin", 0.15, True, Outcome.AMBIGUOUS, "another pose fits about as well"),
    Bound(
        "rendered_inliers",
        0.8,
        True,
        Outcome.RENDERING_MISMATCH,
        "only {0:.0%} of the rendered rays agree with the measurements",
    ),
    # Of the answers on record, 16 of the 17 right ones and 2 of the 15 wrong ones (most with wrong intrinsics) were more precise.
    Bound("precision", 0.015, False, Outcome.IMPRECISE, "the position is uncertain by {0:.1%} of the distance"),
    Bound("determined", 1.0, True, Outcome.UNDETERMINED, "the measurements do not determine the pose"),
    Bound(
        "new_inliers",
        0.93,
        True,
        Outcome.RENDERING_MISMATCH,
        "{0:.0%} of newly drawn rays agree with the measurements, expected {1:.0%}",
    ),
    Bound("confidence", ACCEPTED, True, Outcome.UNDETERMINED, "{2} fits about as well"),
    Bound(
        "explained",
        0.5,
        True,
        Outcome.RENDERING_MISMATCH,
        "the pose explains only {0:.0%} of the contrast of the image",
    ),
    # At right poses in front of a weakly textured wall, seen from twelve places, the noise of the rays causes steps of up to 0.018.
    Bound(
        "further_step",
        0.02,
        False,
        Outcome.NOT_SETTLED,
        "newly drawn rays give a further step of {0:.3g}, expected {1:g} at most",
    ),
    # A wrong pose can be a local optimum whose nearby rivals are no better, but its colours differ more. On test images of
    # Lego and the room, the ratio was 0.8 to 1.4 at right poses, and 2.1 and more at wrong ones.
    Bound(
        "colour_ratio",
        1.8,
        False,
        Outcome.RENDERING_MISMATCH,
        "the colours differ {0:.1f} times as much as in the map's own images",
    ),
    # A squared Mahalanobis distance: five standard deviations.
    Bound(
        "innovation",
        25.0,
        False,
        Outcome.AMBIGUOUS,
        "the measurements fit a place that is inconsistent with the motion",
    ),
    Bound("timed", 1.0, True, Outcome.IMPRECISE, "without a time stamp the motion is unknown"),
    Bound(
        "beside_images",
        4.5,
        False,
        Outcome.IMPRECISE,
        "the position is uncertain by {0:.1f} times the usual error of the map's own images",
    ),
    Bound("confirmed", 1.0, True, Outcome.TOO_FEW_MATCHES, "hardly any landmarks match, although many are visible"),
    Bound(
        "known_focal",
        1.0,
        True,
        Outcome.IMPRECISE,
        "the focal length is approximate, and only landmarks can separate it from the distance",
    ),
)
"""The bounds of a pose without landmarks, the most serious reason first."""
RIVALS = {
    "plain": (Outcome.UNDETERMINED, "a single-colour image"),
    "displaced": (Outcome.UNDETERMINED, f"a pose displaced by {DISPLACEMENT:.0%} of the distance to the scene"),
    "other": (Outcome.AMBIGUOUS, "another pose"),
}
"""The outcome and the description of each rival of a pose without landmarks, by the name of the log odds against it: a single-colour image,
the best of the displaced poses, and the best different pose of a search."""
Costs = Callable[[SE3], Float[Tensor, "h n"]]
"""Returns the cost of each of n measurements at each of h poses."""


@dataclass(frozen=True)
class Support:
    """How well measurements other than landmarks support a pose."""

    # those of ``SUPPORT_BOUNDS``, and the log odds against ``RIVALS``; None or absent: not measured
    measures: dict[str, float | None]
    limits: dict[str, float] = field(default_factory=dict)  # by measure; they replace the usual limits

    @property
    def bounds(self) -> Iterator[tuple[Bound, float]]:
        """The bounds on the measures that were taken, with the method's limits, each paired with the value of its measure."""
        for bound in SUPPORT_BOUNDS:
            value = self.measures.get(bound.measure)
            if value is not None:
                yield bound._replace(limit=self.limits.get(bound.measure, bound.limit)), value

    def verdict(self, accepted: str) -> Verdict:
        """Return the verdict of the first violated bound or, if all bounds hold, acceptance with the reason ``accepted``."""
        for bound, value in self.bounds:
            if bound.keeps(value):
                continue
            if bound.measure != "confidence":
                return Verdict(bound.outcome, bound.reason.format(value, bound.limit))
            against = {name: each for name in RIVALS if (each := self.measures.get(name)) is not None}
            outcome, rival = RIVALS[min(against, key=against.__getitem__)]
            return Verdict(outcome, bound.reason.format(value, bound.limit, rival), value)
        return Verdict(Outcome.CONVERGED, accepted, self.measures.get("confidence"))


def odds(log_odds: float) -> float:
    """Return the odds for ``log_odds``, clamped to the range of floating-point numbers."""
    return math.exp(max(-500.0, min(500.0, log_odds)))


def support(
    costs: Costs,
    T: SE3,
    middle: Float[Tensor, "3"],
    plain: Float[Tensor, "n"] | None = None,
    others: SE3 | None = None,
) -> dict[str, float | None]:
    """Compare a pose with its rivals; return log odds, confidence and explained contrast, as in ``Support.measures``.

    ``middle`` is the middle of the visible scene (metres, last camera's frame), about which rivals are displaced. ``plain`` is each
    measurement's cost in images rendered in their mean colour; None unless colours alone are compared. ``others`` are poses (h) found by a
    search; those within ``DISPLACEMENT`` of ``T`` do not count as rivals.
    """
    here = costs(T[None])[0]
    reach = float(torch.linalg.vector_norm(middle))
    # Twelve poses, displaced in both directions along and about each axis.
    size = torch.tensor([DISPLACEMENT * reach] * 3 + [DISPLACEMENT] * 3, dtype=torch.float64)
    steps = torch.cat([torch.diag(size), -torch.diag(size)]).to(T.translation)
    many = SE3(T.rotation.expand(12, 3, 3), T.translation.expand(12, 3))
    against = {} if plain is None else {"plain": float(log_odds(plain[None], here)[0])}
    against["displaced"] = float(log_odds(costs(many.retract_about(middle, steps)), here).min())
    if others is not None and len((far := others[~same_pose(T, others, middle)]).translation):
        against["other"] = float(log_odds(costs(far), here).min())
    # An image without any contrast leaves nothing to explain.
    explained = None if plain is None else max(0.0, 1 - float((here.sum() / plain.sum()).nan_to_num(1.0)))
    # The posterior probability of the pose, with equal prior odds against each rival.
    confidence = 1 / (1 + sum(odds(-each) for each in against.values()))
    return {**against, "confidence": confidence, "explained": explained}


def log_odds(rivals: Float[Tensor, "h n"], here: Float[Tensor, "n"]) -> Float[Tensor, "h"]:
    """Return the log odds of the pose against each rival, from each measurement's cost at the rivals and ``here``; 0 where not finite."""
    difference = rivals - here
    error = difference.std(-1) * difference.shape[-1] ** 0.5
    # Half a unit of log odds per standard error of the difference: independent measurements would justify more, but the errors of
    # a field's rays are correlated. The factor was chosen on frames held out for tuning.
    odds = 0.5 * difference.sum(-1) / error.clamp(min=1e-12)
    return torch.where(odds.isfinite(), odds, 0)


def same_pose(T: SE3, others: SE3, middle: Float[Tensor, "3"], within: float = DISPLACEMENT) -> Bool[Tensor, "h"]:
    """Return a mask of the ``others`` (h) that differ from ``T`` by at most ``within``.

    ``within`` limits both the displacement of the ``middle`` of the visible scene (metres, last camera's frame), as a fraction of the
    distance to the middle, and the angle in radians.
    """
    middle = middle.to(T.translation)
    shift = torch.linalg.vector_norm(others.apply(middle) - T.apply(middle), dim=-1)
    trace = (T.rotation.mT @ others.rotation).diagonal(dim1=-2, dim2=-1).sum(-1)
    return (shift <= within * torch.linalg.vector_norm(middle)) & (trace >= 1 + 2 * math.cos(within))
