"""Hypotheses about an image's camera and its motion, and their probabilities given the image's keypoints.

Each hypothesis has a prior probability, and is a Gaussian prior on the same few parameters: the correction of the stated
intrinsics and the camera's motion during the readout. The keypoints are fitted once with all parameters free; linear algebra then
gives the evidence for each hypothesis in Laplace's approximation (MacKay 2003, ch. 28), with the pose under it and its
covariance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics, MotionPrior
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.chance import log_odds_of
from bidnerf_core.localization.landmarks.map_camera import SHARE_SAME_CAMERA, MapCamera
from bidnerf_core.mapping import (
    ANY,
    CALIBRATED,
    CROPPED,
    CROPS,
    FIXED,
    GIVEN,
    MISTAKEN,
    MISTAKES,
    NOMINAL,
    RESECTION_STEPS,
    RIGHT,
    USUAL,
    USUALLY,
    Array,
    Calibration,
    CalibrationPrior,
    Conditional,
    EliminatedPose,
    LandmarkMap,
    ObservedPoints,
    ReprojectionErrors,
    State,
    minimized,
)

SHARE_MOVING, SHARE_AS_MAP = 1 / 30, 0.8
"""Prior probability that an image has motion during readout, and the same if the map's images do.

The first is low because image stabilisers, and lens distortion that is not modelled, distort images in similar ways.
"""
MIN_POINTS = 20
"""Minimum number of points for estimating a motion; with fewer, the noise is as uncertain as the motion itself."""


class Stated(StrEnum):
    """What may be true of the stated intrinsics: the names of hypotheses that do not replace them by the map's."""

    EXACT = "stated"
    INEXACT = "inexact"  # right to the accuracy usual for devices
    APPROXIMATE = (
        "approximate"  # and stated to be; intrinsics are estimated under this hypothesis and those below
    )
    CROPPED = "cropped"
    WRONG = "mistaken"


class Whose(StrEnum):
    """Source of the intrinsics with which an image is localized."""

    GIVEN = "given"
    MAP = "map"
    ESTIMATED = "estimated"


class Motion(StrEnum):
    """Motion of the camera during the readout."""

    STILL = "still"
    MOVING = "moving"


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A prior on the correction of the stated intrinsics."""

    name: str
    whose: Whose
    log_prior: float
    refitted: CalibrationPrior  # prior of the refit under it, about the stated intrinsics; ``FIXED``: nothing is estimated
    mean: Float[Tensor, "5"]  # in the order of ``Calibration``
    deviations: Float[Tensor, "5"]  # of the correction about its mean
    camera: Intrinsics | None = None  # the map's

    @property
    def group(self) -> str:
        """Name of the group of similar hypotheses: that the stated intrinsics are right, or that they are wrong."""
        if self.name in (Stated.EXACT, Stated.INEXACT):
            return Stated.EXACT
        return self.name if self.camera is not None else Whose.ESTIMATED


def camera_hypotheses(cameras: Sequence[MapCamera], prior: CalibrationPrior = FIXED) -> list[Hypothesis]:
    """Return all hypotheses about the intrinsics of an image, with their priors.

    ``cameras`` are the map's, relative to the stated intrinsics. ``prior`` is that of the stated intrinsics if they are
    approximate and therefore always estimated.
    """

    def about(
        name: str, share: float, prior: CalibrationPrior, estimated: CalibrationPrior = FIXED
    ) -> Hypothesis:
        whose = Whose.GIVEN if estimated == FIXED else Whose.ESTIMATED
        deviations = prior.deviations.clamp(min=CALIBRATED.stretch)
        return Hypothesis(
            name,
            whose,
            math.log(share),
            estimated,
            torch.zeros_like(deviations),
            deviations,
        )

    if prior != FIXED:
        own = [about(Stated.APPROXIMATE, 1 - CROPS, prior, prior)]
        if prior.shift < ANY.shift:
            cropped = replace(prior, shift=ANY.shift)
            own.append(about(Stated.CROPPED, CROPS, cropped, cropped))
        of_map = [(camera, log_odds_of(SHARE_SAME_CAMERA)) for camera in cameras]
    else:
        # If the stated intrinsics are those of the map, they are wrong only where the image is from another camera.
        as_map = any(camera.is_near(CALIBRATED) and not bool(camera.differs.any()) for camera in cameras)
        share = 1 - SHARE_SAME_CAMERA if as_map else 1.0
        wrong = (MISTAKES + CROPS) * share
        own = [
            about(Stated.EXACT, 1 - USUALLY - wrong, RIGHT),
            about(Stated.INEXACT, USUALLY, USUAL),
            # A mistaken parameter may be off by any amount, so it is estimated without its prior.
            about(Stated.WRONG, MISTAKES * share, MISTAKEN, NOMINAL),
            about(Stated.CROPPED, CROPS * share, CROPPED, CROPPED),
        ]
        of_map = [(camera, camera.log_odds) for camera in cameras if bool(camera.differs.any())]
    found = [
        Hypothesis(
            f"map {number}",
            Whose.MAP,
            log_odds - math.log(len(of_map)),
            FIXED,
            camera.correction,
            torch.maximum(camera.deviations, RIGHT.deviations),
            camera.intrinsics,
        )
        for number, (camera, log_odds) in enumerate(of_map)
        if math.isfinite(log_odds)
    ]
    return [*own, *found]


def share_moving(landmarks: LandmarkMap) -> float:
    """Return the prior probability of a motion during readout, since the camera may be that of the map's images."""
    return max(SHARE_MOVING, SHARE_AS_MAP * landmarks.moving)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A hypothesis about the camera and its motion, given the keypoints."""

    hypothesis: Hypothesis
    motion: Motion
    log_evidence: float  # including the log prior, up to a constant
    update: Float[Tensor, "6"]  # right update of the pose of the fit with all parameters free
    parameters: Float[Tensor, "11"]  # most probable calibration and motion
    covariance: Float[Tensor, "6 6"]  # of the pose, due to the calibration and the motion
    by_motion: Float[Tensor, "6 6"]  # the part that remains with a known calibration
    by_fit: Float[
        Tensor, "6 6"
    ]  # ``covariance`` without the scatter of calibrations among the map's own images

    @property
    def calibration(self) -> Calibration:
        """The most probable correction of the stated intrinsics."""
        return Calibration(*self.parameters[:5].tolist())

    @property
    def taken(self) -> Calibration:
        """The correction with which an image is localized if none is estimated along with the pose."""
        if self.hypothesis.name == Stated.EXACT:
            return GIVEN
        known = self.hypothesis.camera is not None
        return Calibration(*self.hypothesis.mean.tolist()) if known else self.calibration

    def is_as(self, other: Explanation) -> bool:
        """Return whether both have the same intrinsics and kind of motion."""
        return self.hypothesis.name == other.hypothesis.name and self.motion is other.motion

    def intrinsics(self, given: Intrinsics) -> Intrinsics:
        """Return the intrinsics with which an image with the ``given`` ones is localized."""
        return self.hypothesis.camera or self.taken.applied(given)


@dataclass(frozen=True, eq=False)
class Posterior:
    """The explanations of an image, and their probabilities."""

    T_world_rig: SE3  # of the fit with all parameters free
    noise: float  # of that fit, pixels
    apparent: Float[Tensor, "5"]  # the correction of that fit, in the order of ``Calibration``
    deviations: Float[Tensor, "5"]  # its standard deviations due to the noise of keypoints
    distance: float  # metres: median depth of the landmarks
    explanations: tuple[Explanation, ...]
    chosen: Explanation | None = None  # the explanation to use, whatever its probability

    @property
    def stated(self) -> Explanation:
        """The explanation with the stated intrinsics, exact or approximate, and a static camera."""
        return self.explanations[0]

    def with_best(self, explanation: Explanation, T_world_rig: SE3 | None = None) -> Posterior:
        """Return the posterior with the equivalent of a given explanation as its ``best``, whatever its probability.

        ``T_world_rig`` is the pose fitted under it, relative to which the shifts of all others are measured.
        """
        best = next(each for each in self.explanations if each.is_as(explanation))
        if T_world_rig is None:
            return replace(self, chosen=best)
        fitted = replace(best, update=(self.T_world_rig.inverse() @ T_world_rig).log())
        explanations = tuple(fitted if each is best else each for each in self.explanations)
        return replace(self, explanations=explanations, chosen=fitted)

    @cached_property
    def probabilities(self) -> list[float]:
        """The probabilities of the explanations, which sum to 1."""
        odds = torch.tensor([each.log_evidence for each in self.explanations], dtype=torch.float64)
        found: list[float] = odds.softmax(0).tolist()
        return found

    @cached_property
    def best(self) -> Explanation:
        """The explanation to use: ``chosen``, or that of the most probable intrinsics (see ``best_of``)."""
        if self.chosen is not None:
            return self.chosen
        totals: dict[str, float] = {}
        for each, p in self._weighted:
            totals[each.hypothesis.name] = totals.get(each.hypothesis.name, 0.0) + p
        return self.best_of(max(totals, key=lambda key: totals[key]))

    def best_of(self, name: str) -> Explanation:
        """Return the explanation to use for a hypothesis: moving or static, whichever is more probable."""
        inside = [pair for pair in self._weighted if pair[0].hypothesis.name == name]
        return max(inside, key=lambda pair: pair[1])[0]

    @property
    def with_stated(self) -> Posterior:
        """The posterior with the best explanation by the stated intrinsics as its ``best``, whatever their probability."""
        return self.with_best(self.best_of(self.stated.hypothesis.name))

    @property
    def _weighted(self) -> list[tuple[Explanation, float]]:
        return list(zip(self.explanations, self.probabilities, strict=True))

    @property
    def _others(self) -> list[tuple[Explanation, float]]:
        """The explanations of other groups than the best; the spread within its own group is part of the covariance."""
        return [(e, p) for e, p in self._weighted if e.hypothesis.group != self.best.hypothesis.group]

    def shift(self, explanation: Explanation) -> Float[Tensor, "6"]:
        """Return the right update from the pose of the best explanation to that of another."""
        return explanation.update - self.best.update

    def pose(self, explanation: Explanation) -> SE3:
        """Return the pose under an explanation."""
        return self.T_world_rig.retract(explanation.update)

    @property
    def wrong(self) -> float:
        """The probability that neither the stated intrinsics nor the map's are even approximately right."""
        return sum(p for e, p in self._weighted if e.hypothesis.group == Whose.ESTIMATED)

    @property
    def expected_shift(self) -> float:
        """The sum over all other intrinsics of their probability times the resulting shift of the position (metres)."""
        return sum(p * float(self.shift(e)[:3].norm()) for e, p in self._others)

    @property
    def riskiest(self) -> Explanation | None:
        """The explanation with other intrinsics that contributes most to ``expected_shift``."""
        others = self._others
        if not others:
            return None
        return max(others, key=lambda pair: pair[1] * float(self.shift(pair[0])[:3].norm()))[0]

    def updated(self, log_odds: Mapping[str, float]) -> Posterior:
        """Update the posterior with log odds of groups from further evidence: renderings, a start or another sensor."""
        explanations = tuple(
            replace(each, log_evidence=each.log_evidence + log_odds.get(each.hypothesis.group, 0.0))
            for each in self.explanations
        )
        return replace(self, explanations=explanations, chosen=None)

    @property
    def doubt_of_motion(self) -> Float[Tensor, "6 6"]:
        """Covariance of the pose due to uncertainty about the motion, in addition to that of ``best``, for known intrinsics."""
        best = self.best
        same = [(e, p) for e, p in self._weighted if e.hypothesis is best.hypothesis]
        return _moment(same, best.update, "by_motion") - best.by_motion

    @property
    def doubt_of_camera(self) -> Float[Tensor, "6 6"]:
        """Further covariance of the pose due to uncertainty about the intrinsics."""
        best = self.best
        own = best.by_fit if best.hypothesis.whose is Whose.ESTIMATED else best.by_motion
        found = _moment(self._weighted, best.update, "covariance") - own - self.doubt_of_motion
        values, vectors = torch.linalg.eigh((found + found.mT) / 2)
        return vectors @ torch.diag(values.clamp(min=0)) @ vectors.mT


def _moment(
    weighted: Sequence[tuple[Explanation, float]], update: Float[Tensor, "6"], which: str
) -> Float[Tensor, "6 6"]:
    """Return the mixture's second moment of the pose about an update; its components have the covariances ``which``."""
    total, whole = torch.zeros((6, 6), dtype=torch.float64), sum(p for _, p in weighted)
    for each, p in weighted:
        off = each.update - update
        total += p / whole * (getattr(each, which) + torch.outer(off, off))
    return total


def posterior(
    data: ObservedPoints,
    start: SE3,
    noise: float,
    which: Sequence[Hypothesis],
    correlation: float,
    calibration: Calibration,
    scatter: Float[Tensor, "4"],
    share: float = 0.0,
    steps: int = RESECTION_STEPS,
) -> Posterior:
    """Return the probabilities of hypotheses given observations with the stated intrinsics, and the pose under each.

    ``start`` and ``calibration`` are the initial values of the fit, ``noise`` (pixels) is a first guess, ``correlation`` the
    number of observations that count as one, and ``share`` the prior probability of a motion during readout (0: static).
    ``scatter`` are the standard deviations of spurious corrections to right intrinsics, from images of the map. The fit takes at
    most ``steps`` steps; from a close start, few suffice, and linear algebra does the rest.
    """
    mean, deviations = (
        torch.stack([getattr(each, name) for each in which]).numpy() for name in ("mean", "deviations")
    )
    distance = float(data.in_camera(start)[:, 2].median())
    usual = MotionPrior.usual(distance).deviations.numpy()
    if share == 0 or len(data) < MIN_POINTS:
        share, usual = 0.0, np.zeros(6)
    widest = np.hypot(np.maximum(deviations, np.abs(mean)).max(0), np.append(scatter.numpy(), 0.0))
    wide = np.concatenate([widest, usual])
    free, spurious = wide.nonzero()[0], np.concatenate([scatter.numpy(), np.zeros(7)])
    errors = ReprojectionErrors(data, start)
    here, system, fitted = minimized(
        errors, State.of(start, calibration), wide, noise, correlation, steps=steps
    )
    eliminated = EliminatedPose.of(
        errors.system(here, fitted).weighted(1 / correlation), here.state.camera[free]
    )
    found: list[Explanation] = []
    for motion, prior, moving in ((Motion.STILL, 1 - share, np.zeros(6)), (Motion.MOVING, share, usual)):
        if prior == 0:
            continue
        priors = np.concatenate([deviations, np.tile(moving, (len(which), 1))], axis=1)[:, free]
        means = np.concatenate([mean, np.zeros((len(which), 6))], axis=1)[:, free]
        explained = eliminated.given(means, priors, spurious[free])
        known = eliminated.given(means[:1], np.where(free < 5, 0.0, priors[:1]), 0.0 * spurious[free])
        found += _explanations(which, motion, explained, known.covariance[0], free, prior)
    spread = np.zeros(11)
    spread[free] = np.sqrt(np.diag(np.linalg.inv(system.hessian))[6:].clip(min=0))
    apparent, certain = (torch.from_numpy(value[:5].copy()) for value in (here.state.camera, spread))
    return Posterior(here.state.pose(), fitted, apparent, certain, distance, tuple(found))


def _explanations(
    which: Sequence[Hypothesis],
    motion: Motion,
    explained: Conditional,
    by_motion: Array,
    free: Array,
    share: float,
) -> list[Explanation]:
    """Return the explanations by each hypothesis with a kind of motion, whose prior probability is ``share``."""
    parameters = np.zeros((len(which), 11))
    parameters[:, free] = explained.parameters
    evidence = explained.log_evidence + math.log(share)
    update, covariance, by_fit = (
        torch.from_numpy(part) for part in (explained.update, explained.covariance, explained.by_fit)
    )
    return [
        Explanation(
            each,
            motion,
            each.log_prior + float(evidence[i]),
            update[i],
            torch.from_numpy(parameters[i]),
            covariance[i],
            torch.from_numpy(by_motion),
            by_fit[i],
        )
        for i, each in enumerate(which)
    ]
