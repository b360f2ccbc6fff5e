"""Who took this image, and how: hypotheses about its camera, and their probabilities given the image's keypoints.

Each hypothesis is a Gaussian prior on the same few numbers, the correction of the stated intrinsics and the motion of the camera
while its rows were exposed, and has a prior probability. The keypoints are fitted once, with all of these numbers free; linear
algebra gives the evidence for each hypothesis in Laplace's approximation (MacKay 2003, ch. 28), the pose under it and its
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

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.rolling_shutter import MotionPrior
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.landmarks.map_camera import SAME_LOG_ODDS, SHARE_SAME_CAMERA, MapCamera
from bidnerf_core.mapping.geometry.calibration import (
    ANY,
    CALIBRATED,
    CROPPED,
    CROPS,
    FIXED,
    GIVEN,
    MISTAKEN,
    MISTAKES,
    NOMINAL,
    RIGHT,
    USUAL,
    USUALLY,
    Calibration,
    CalibrationPrior,
)
from bidnerf_core.mapping.geometry.eliminated_pose import TIED, Conditional, EliminatedPose
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.projection import Array
from bidnerf_core.mapping.geometry.reprojection import ReprojectionErrors, State
from bidnerf_core.mapping.geometry.resection import RESECTION_STEPS, minimized
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap

CROPS_BESIDE_APPROXIMATE = 0.1
"""Share of crops among images whose focal length is approximate."""
SHARE_MOVING, SHARE_AS_MAP = 1 / 30, 0.8
"""Prior probability that an image shows a motion, and that it does if those of the map do.

The first is low because lens stabilisers, and lenses that the intrinsics do not describe, distort images in similar ways.
"""
TRANSPOSED = 0.1
"""Share of the motions in which the rows run across those that the image's shape suggests: crops, turned square images."""
MAX_MOTION = 22.5
"""Largest squared motion, in standard deviations of its prior (chi-squared at 99.9 %, six degrees of freedom).

A larger one more probably makes up for another camera. It is not taken, and the shift of the pose that it brings counts as doubt.
"""
MIN_POINTS = 20
"""Least number of points that determine a motion: with fewer, the noise is as uncertain as the motion itself."""

APPROXIMATE, CROPPED_IMAGE, WRONG_FOCAL, WRONG_CAMERA = (
    "approximate",
    "cropped",
    "mistaken focal length",
    "mistaken",
)
"""Names of the hypotheses under which intrinsics are estimated."""
STATED, INEXACT, ESTIMATED = "stated", "inexact", "estimated"
"""Names of the hypotheses that the stated intrinsics are right, exactly and as far as devices usually state them, and of the group of
those that they are wrong or unknown.
"""


class Whose(StrEnum):
    """Whose intrinsics an image is localized with."""

    GIVEN = "given"
    MAP = "map"
    ESTIMATED = "estimated"


class Motion(StrEnum):
    """How the camera moved while its rows were exposed."""

    STILL = "still"
    MOVING = "moving"
    TRANSPOSED = "transposed"  # moving, and its rows run along the other axis


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A prior on the correction of the stated intrinsics."""

    name: str
    whose: Whose
    log_prior: float
    refitted: CalibrationPrior  # what a fit under it estimates anew, about the stated intrinsics; ``FIXED``: nothing
    mean: Float[Tensor, "5"]  # in the order of ``Calibration``
    deviations: Float[Tensor, "5"]  # of the correction about its mean
    camera: Intrinsics | None = None  # the map's

    @property
    def group(self) -> str:
        """The hypotheses that differ in size alone: of the same stated intrinsics, or of intrinsics that are wrong."""
        if self.name in (STATED, INEXACT):
            return STATED
        return self.name if self.camera is not None else ESTIMATED


def camera_hypotheses(cameras: Sequence[MapCamera], prior: CalibrationPrior = FIXED) -> list[Hypothesis]:
    """Return all hypotheses about the intrinsics of an image, with their priors.

    ``cameras``: those of the map, relative to the stated intrinsics. ``prior``: how uncertain the stated intrinsics are, if they
    are approximate and therefore estimated in any case.
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
        own = [about(APPROXIMATE, 1 - CROPS_BESIDE_APPROXIMATE, prior, prior)]
        if prior.shift < ANY.shift:
            cropped = replace(prior, shift=ANY.shift)
            own.append(about(CROPPED_IMAGE, CROPS_BESIDE_APPROXIMATE, cropped, cropped))
        of_map = [(camera, SAME_LOG_ODDS) for camera in cameras]
    else:
        # If the stated intrinsics are those of the map, they are wrong only where the image is from another camera.
        as_map = any(camera.is_near(CALIBRATED) and not bool(camera.differs.any()) for camera in cameras)
        share = 1 - SHARE_SAME_CAMERA if as_map else 1.0
        wrong = (MISTAKES + CROPS) * share
        other_focal = replace(USUAL, log_focal=MISTAKEN.log_focal)
        own = [
            about(STATED, 1 - USUALLY - wrong, RIGHT),
            about(INEXACT, USUALLY, USUAL),
            # What is wrong may be so by any amount: it is estimated without its prior.
            about(
                WRONG_FOCAL,
                0.6 * MISTAKES * share,
                other_focal,
                replace(other_focal, log_focal=ANY.log_focal),
            ),
            about(WRONG_CAMERA, 0.4 * MISTAKES * share, MISTAKEN, NOMINAL),
            about(CROPPED_IMAGE, CROPS * share, CROPPED, CROPPED),
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
    """Return the prior probability that an image of the scene shows a motion: its camera may be that of the map's images."""
    return max(SHARE_MOVING, SHARE_AS_MAP * landmarks.moving)


@dataclass(frozen=True, eq=False)
class Explanation:
    """A hypothesis about the camera and its motion, given the keypoints."""

    hypothesis: Hypothesis
    motion: Motion
    log_evidence: float  # with the log prior, up to a constant
    update: Float[Tensor, "6"]  # right update of the pose of the fit in which everything is free
    parameters: Float[Tensor, "11"]  # most probable calibration and motion
    covariance: Float[Tensor, "6 6"]  # of the pose, due to the calibration and the motion
    by_motion: Float[Tensor, "6 6"]  # the part that is left with a known calibration
    by_fit: Float[
        Tensor, "6 6"
    ]  # ``covariance`` without the scatter of calibrations among the map's own images
    is_plausible: bool = True  # whether its motion is not larger than cameras move

    @property
    def calibration(self) -> Calibration:
        """The most probable correction of the stated intrinsics."""
        return Calibration(*self.parameters[:5].tolist())

    @property
    def taken(self) -> Calibration:
        """The correction with which an image is localized where none is estimated along with the pose."""
        if self.hypothesis.name == STATED:
            return GIVEN
        known = self.hypothesis.camera is not None
        return Calibration(*self.hypothesis.mean.tolist()) if known else self.calibration

    def is_as(self, other: Explanation) -> bool:
        """Return whether the image is localized in the same way with both: the same intrinsics and motion."""
        return self.hypothesis.name == other.hypothesis.name and self.motion is other.motion

    def intrinsics(self, given: Intrinsics) -> Intrinsics:
        """Return the intrinsics with which to localize an image that states the ``given`` ones."""
        return self.hypothesis.camera or self.taken.applied(given)


@dataclass(frozen=True, eq=False)
class Posterior:
    """The explanations of an image, and their probabilities."""

    T_world_rig: SE3  # of the fit in which everything is free
    noise: float  # pixels, of that fit
    apparent: Float[Tensor, "5"]  # the correction of that fit, in the order of ``Calibration``
    deviations: Float[Tensor, "5"]  # its standard deviations due to the noise of keypoints
    distance: float  # metres: median depth of the landmarks
    explanations: tuple[Explanation, ...]
    chosen: Explanation | None = None  # one to localize with however probable it is

    @property
    def stated(self) -> Explanation:
        """The explanation that the stated intrinsics are right, or approximately right, and the camera was at rest."""
        return self.explanations[0]

    def with_best(self, explanation: Explanation, T_world_rig: SE3 | None = None) -> Posterior:
        """Return the posterior with the explanation like a given one as its ``best``, however probable that is.

        ``T_world_rig`` is the pose that was fitted under it, from which the shifts to all others are measured.
        """
        best = next(each for each in self.explanations if each.is_as(explanation))
        if T_world_rig is None:
            return replace(self, chosen=best)
        fitted = replace(best, update=(self.T_world_rig.inverse() @ T_world_rig).log())
        explanations = tuple(fitted if each is best else each for each in self.explanations)
        return replace(self, explanations=explanations, chosen=fitted)

    @cached_property
    def probabilities(self) -> list[float]:
        """The probability of each explanation; they add up to 1."""
        odds = torch.tensor([each.log_evidence for each in self.explanations], dtype=torch.float64)
        found: list[float] = odds.softmax(0).tolist()
        return found

    @cached_property
    def best(self) -> Explanation:
        """The explanation with which to localize the image: ``chosen``, or that of the most probable intrinsics (``best_of``)."""
        if self.chosen is not None:
            return self.chosen
        totals: dict[str, float] = {}
        for each, p in self._weighted:
            totals[each.hypothesis.name] = totals.get(each.hypothesis.name, 0.0) + p
        return self.best_of(max(totals, key=lambda key: totals[key]))

    def best_of(self, name: str) -> Explanation:
        """Return the explanation of a hypothesis with which it is localized, with the more probable of a motion and none.

        A motion is taken where it is more probable than all else. The motion of rows across those that the image's shape suggests is never taken: it counts as doubt.
        """
        inside = [(each, p) for each, p in self._weighted if each.hypothesis.name == name]
        moving = sum(p for each, p in inside if each.motion is Motion.MOVING and each.is_plausible)
        still = sum(p for each, p in inside) - moving
        motion = Motion.MOVING if moving > still else Motion.STILL
        return next(each for each, _ in inside if each.motion is motion)

    @property
    def with_stated(self) -> Posterior:
        """The posterior with the best explanation by the stated intrinsics as its ``best``, however probable these are."""
        return self.with_best(self.best_of(self.stated.hypothesis.name))

    @property
    def _weighted(self) -> list[tuple[Explanation, float]]:
        return list(zip(self.explanations, self.probabilities, strict=True))

    @property
    def _others(self) -> list[tuple[Explanation, float]]:
        """The explanations of other groups than the best; what is left open within its group is part of the covariance."""
        return [(e, p) for e, p in self._weighted if e.hypothesis.group != self.best.hypothesis.group]

    def shift(self, explanation: Explanation) -> Float[Tensor, "6"]:
        """Return the right update from the pose of the best explanation to that of another."""
        return explanation.update - self.best.update

    def pose(self, explanation: Explanation) -> SE3:
        """Return the pose under an explanation."""
        return self.T_world_rig.retract(explanation.update)

    @property
    def wrong(self) -> float:
        """The probability that neither the stated intrinsics nor those of the map's images are right, not even nearly."""
        return sum(p for e, p in self._weighted if e.hypothesis.group == ESTIMATED)

    @property
    def expected_shift(self) -> float:
        """The sum over all other intrinsics of their probability times the shift of the position that they bring (metres)."""
        return sum(p * float(self.shift(e)[:3].norm()) for e, p in self._others)

    @property
    def riskiest(self) -> Explanation | None:
        """The explanation with other intrinsics that contributes most to ``expected_shift``."""
        others = self._others
        if not others:
            return None
        return max(others, key=lambda pair: pair[1] * float(self.shift(pair[0])[:3].norm()))[0]

    def updated(self, log_odds: Mapping[str, float]) -> Posterior:
        """Return the posterior with the log odds of groups by further evidence: renderings, a start, another sensor."""
        explanations = tuple(
            replace(each, log_evidence=each.log_evidence + log_odds.get(each.hypothesis.group, 0.0))
            for each in self.explanations
        )
        return replace(self, explanations=explanations, chosen=None)

    @property
    def doubt_of_motion(self) -> Float[Tensor, "6 6"]:
        """What the doubt about the motion adds to the covariance of a pose with known intrinsics."""
        best = self.best
        same = [(e, p) for e, p in self._weighted if e.hypothesis is best.hypothesis]
        return _moment(same, best.update, "by_motion") - best.by_motion

    @property
    def doubt_of_camera(self) -> Float[Tensor, "6 6"]:
        """What the doubt about the intrinsics adds to that."""
        best = self.best
        own = best.by_fit if best.hypothesis.whose is Whose.ESTIMATED else best.by_motion
        found = _moment(self._weighted, best.update, "covariance") - own - self.doubt_of_motion
        values, vectors = torch.linalg.eigh((found + found.mT) / 2)
        return vectors @ torch.diag(values.clamp(min=0)) @ vectors.mT


def _moment(
    weighted: Sequence[tuple[Explanation, float]], update: Float[Tensor, "6"], which: str
) -> Float[Tensor, "6 6"]:
    """Return the second moment of the pose about an update, of a mixture whose parts have the covariances ``which``."""
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
    """Return the probabilities of hypotheses given observations with the stated intrinsics, and the pose under each of them.

    ``start`` and ``calibration`` are where the fit starts, ``noise`` (pixels) is a first guess, ``correlation`` the number of
    observations that count as one, and ``share`` the prior probability of a motion between rows; 0 for a camera at rest.
    ``scatter``: standard deviations of the corrections that images of the map seem to need although their intrinsics are right.
    ``steps`` are taken at most to fit the observations; where the start is near, few leave the rest to the linear algebra.
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
    still = ReprojectionErrors(data, start)
    ways: dict[ReprojectionErrors, tuple[Motion, ...]] = {still: (Motion.STILL,)}
    if share:
        ways[still] = (Motion.STILL, Motion.MOVING)
        ways[still.exposed_at(data.transposed_exposure_times)] = (Motion.TRANSPOSED,)
    state = State.of(start, calibration)
    fits = [(errors, *minimized(errors, state, wide, noise, correlation, steps=steps)) for errors in ways]
    least = min(fitted for *_, fitted in fits)
    shares = {
        Motion.STILL: 1 - share,
        Motion.MOVING: share * (1 - TRANSPOSED),
        Motion.TRANSPOSED: share * TRANSPOSED,
    }
    T, found = fits[0][1].state.pose(), []
    for errors, here, _, _ in fits:
        system = errors.system(here, least).weighted(1 / correlation)
        eliminated = EliminatedPose.of(system, here.state.camera[free])
        offset = (T.inverse() @ here.state.pose()).log()
        for motion in ways[errors]:
            moving = np.zeros(6) if motion is Motion.STILL else usual
            priors = np.concatenate([deviations, np.tile(moving, (len(which), 1))], axis=1)[:, free]
            means = np.concatenate([mean, np.zeros((len(which), 6))], axis=1)[:, free]
            explained = eliminated.given(means, priors, spurious[free])
            known = eliminated.given(means[:1], np.where(free < 5, 0.0, priors[:1]), 0.0 * spurious[free])
            found += _explanations(
                which, motion, explained, known.covariance[0], usual, free, shares[motion], offset
            )
    _, here, system, _ = fits[0]
    spread = np.zeros(11)
    spread[free] = np.sqrt(np.diag(np.linalg.inv(system.hessian))[6:].clip(min=0))
    apparent, certain = (torch.from_numpy(value[:5].copy()) for value in (here.state.camera, spread))
    return Posterior(T, least, apparent, certain, distance, tuple(found))


def _explanations(
    which: Sequence[Hypothesis],
    motion: Motion,
    explained: Conditional,
    by_motion: Array,
    usual: Array,
    free: Array,
    share: float,
    offset: Float[Tensor, "6"],
) -> list[Explanation]:
    """Return what the unknowns are under each hypothesis with a motion, whose prior probability is ``share``."""
    parameters = np.zeros((len(which), 11))
    parameters[:, free] = explained.parameters
    sizes = ((parameters[:, 5:] / np.maximum(usual, TIED)) ** 2).sum(1)
    evidence = explained.log_evidence + math.log(max(share, 1e-300))
    update, covariance, by_fit = (
        torch.from_numpy(part) for part in (explained.update, explained.covariance, explained.by_fit)
    )
    return [
        Explanation(
            each,
            motion,
            each.log_prior + float(evidence[i]),
            offset + update[i],
            torch.from_numpy(parameters[i]),
            covariance[i],
            torch.from_numpy(by_motion),
            by_fit[i],
            bool(sizes[i] <= MAX_MOTION),
        )
        for i, each in enumerate(which)
    ]
