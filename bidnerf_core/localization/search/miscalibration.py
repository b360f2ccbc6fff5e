"""The probability that a camera's given intrinsics are wrong, judged by those that fit an image best."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.search.map_camera import OTHER_CAMERA, SAME_CAMERA, SAME_LOG_ODDS, MapCamera
from bidnerf_core.mapping.geometry.calibration import (
    ANY,
    CALIBRATED,
    CROPPED,
    CROPS,
    GIVEN,
    MISTAKEN,
    MISTAKES,
    NOMINAL,
    USUAL,
    USUALLY,
    Calibration,
    CalibrationPrior,
)
from bidnerf_core.mapping.geometry.resection import ReprojectionFit
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap

Mixture = tuple[tuple[CalibrationPrior, float], ...]
"""Priors and their shares."""
MISTAKES_AND_CROPS: Mixture = ((MISTAKEN, MISTAKES), (CROPPED, CROPS))
"""Priors of the correction of intrinsics that are wrong, and the shares of cameras to which they apply."""
WRONG_SHARE = sum(share for _, share in MISTAKES_AND_CROPS)
"""Share of cameras whose intrinsics are wrong."""
MIXTURE: Mixture = ((CALIBRATED, 1 - USUALLY - WRONG_SHARE), (USUAL, USUALLY), *MISTAKES_AND_CROPS)
"""Prior of the correction of given intrinsics, which are calibrated, as inexact as usual, or wrong."""
LIKELY = 0.8
"""Probability above which an image whose focal length is approximate is taken to be from the map's camera."""


@dataclass(frozen=True)
class CameraEvidence:
    """Log odds about the camera of an image, by measurements other than the positions of its keypoints."""

    map_camera: float = 0.0  # that the map's intrinsics are right rather than the given ones
    mistaken: float = 0.0  # that those that fit the keypoints best are right rather than the ones taken


NO_EVIDENCE = CameraEvidence()
"""No evidence other than the positions of keypoints."""


@dataclass(frozen=True)
class TakenIntrinsics:
    """The intrinsics with which an image is localized, and others that may be right instead."""

    calibration: Calibration = (
        GIVEN  # correction of the given ones, approximate where the map's camera is taken
    )
    camera: MapCamera | None = None  # the map's, if it is taken
    alternative: Calibration = GIVEN  # correction of those taken
    probability: float = 0.0  # that the alternative is right
    as_map: bool = False  # whether those taken are those of the map's images, and no others were given

    @property
    def log_odds_of_mistake(self) -> float:
        """Prior log odds that the intrinsics taken are wrong.

        If they are also those of the map's images, they are wrong only where the image is from another camera.
        """
        share = WRONG_SHARE * (1 - SAME_CAMERA) if self.as_map else WRONG_SHARE
        return math.log(share / (1 - share))


@dataclass(frozen=True, eq=False)
class Miscalibration:
    """How far the intrinsics that fit an image best are from those taken, and whether these are wrong.

    The intrinsics taken are the given ones, or those of the map's cameras where the image supports these. Images of the map,
    whose intrinsics are right, seem to need corrections, too; their scatter is part of the noise.
    """

    apparent: Float[Tensor, "4"]  # the correction that fits best, in the order of ``Calibration``
    noise: Float[Tensor, "4"]  # standard deviations of that estimate due to the noise of the keypoints
    probability: Float[Tensor, "4"]  # that the parameter taken is wrong
    unresolved: Float[
        Tensor, "4"
    ]  # standard deviation of the true correction about zero, usual errors of cameras included
    alternative: Float[Tensor, "4"]  # correction of those taken to those, given or the map's, that were not
    alternative_probability: Float[Tensor, ""]  # that these are right

    @staticmethod
    def unknown() -> Miscalibration:
        """Return the miscalibration of intrinsics that have not been compared with an image."""
        zero = torch.zeros(4, dtype=torch.float64)
        return Miscalibration(zero, zero, zero, USUAL.deviations, zero, zero[0])

    @staticmethod
    def of(
        free: ReprojectionFit,
        landmarks: LandmarkMap,
        taken: TakenIntrinsics,
        other_log_odds: float = 0.0,
        right: CalibrationPrior = CALIBRATED,
    ) -> Miscalibration:
        """Judge the intrinsics ``taken`` by a fit in which they were free.

        ``other_log_odds``: log odds that they are wrong, by other measurements; they count for each parameter.
        ``right``: how uncertain intrinsics are that are not wrong.
        """
        value, noise = _estimate(free, landmarks)
        value = value - _as_tensor(taken.calibration)
        mistaken = _log_joint(MISTAKES_AND_CROPS, value, noise).logsumexp(0) - math.log(WRONG_SHARE)
        (correct,) = _log_joint(((right, 1.0),), value, noise)
        log_odds = mistaken - correct + taken.log_odds_of_mistake + other_log_odds
        return Miscalibration(
            value, free.calibration_deviations, log_odds.sigmoid(), unresolved_deviations(value, noise),
            _as_tensor(taken.alternative), value.new_tensor(taken.probability),
        )  # fmt: skip

    @property
    def deviations(self) -> Float[Tensor, "4"]:
        """The standard deviation of the true correction about zero."""
        return (CALIBRATED.deviations.square() + self.probability * self.apparent.square()).sqrt()

    def prior(self, right: CalibrationPrior, cropped: bool) -> CalibrationPrior:
        """Return a prior that leaves open the parameters that are probably wrong, and takes the others from ``right``.

        ``cropped``: whether the image is probably a crop.
        """
        focal, u, v, radial = (self.probability > 0.5).tolist()
        unknown = ANY if cropped else NOMINAL
        return CalibrationPrior(
            unknown.log_focal if focal else right.log_focal,
            unknown.shift if u or v else right.shift,
            unknown.radial if radial else right.radial,
        )

    @property
    def worst(self) -> tuple[int, float]:
        """The parameter that is most likely wrong, and the probability that it is."""
        number = int(self.probability.argmax())
        return number, float(self.probability[number])


def taken_intrinsics(
    free: ReprojectionFit,
    landmarks: LandmarkMap,
    camera: MapCamera | None,
    approximate: bool,
    other_log_odds: float = 0.0,
) -> TakenIntrinsics:
    """Return the more probable of the given intrinsics and those of the map's ``camera``, by a fit in which they were free.

    ``approximate``: whether the given focal length is; taking the given intrinsics then means estimating the calibration.
    ``other_log_odds``: log odds that the map's camera is right, by other measurements.
    """
    if camera is None:
        return TakenIntrinsics()
    if approximate:
        probability = probability_beside_approximate(free, landmarks, camera, other_log_odds)
        if probability <= LIKELY:
            return TakenIntrinsics()
        fitted = Calibration(*(_as_tensor(free.calibration) - camera.correction).tolist())
        return TakenIntrinsics(camera.calibration, camera, fitted, 1 - probability, as_map=True)
    if not bool(camera.differs.any()):
        return TakenIntrinsics(as_map=camera.is_near(CALIBRATED))
    if not camera.is_near(OTHER_CAMERA):
        return TakenIntrinsics()
    probability, there = probability_of_map_camera(free, landmarks, camera, other_log_odds), camera.correction
    if probability > 0.5:
        return TakenIntrinsics(camera.calibration, camera, Calibration(*(-there).tolist()), 1 - probability)
    return TakenIntrinsics(alternative=camera.calibration, probability=probability)


def probability_of_map_camera(
    free: ReprojectionFit, landmarks: LandmarkMap, camera: MapCamera, other_log_odds: float = 0.0
) -> float:
    """Return the probability that an image was taken by the map's ``camera`` rather than by one with the given intrinsics.

    The image is represented by a fit in which the intrinsics were free. ``other_log_odds``: log odds by other measurements.
    """
    value, noise = _estimate(free, landmarks)
    by_given = torch.stack([
        _log_density(part, value, noise)[camera.differs].sum() + math.log(share) for part, share in MIXTURE
    ]).logsumexp(0)  # fmt: skip
    evidence = float(_log_density_by(camera, value, noise)[camera.differs].sum() - by_given)
    return float(torch.tensor(evidence + camera.log_odds + other_log_odds, dtype=torch.float64).sigmoid())


def probability_beside_approximate(
    free: ReprojectionFit, landmarks: LandmarkMap, camera: MapCamera, other_log_odds: float = 0.0
) -> float:
    """Return ``probability_of_map_camera`` where the given focal length is approximate, so only the image determines it."""
    if not camera.is_near(NOMINAL):
        return 0.0
    value, noise = _estimate(free, landmarks)
    total = NOMINAL.deviations.square() + noise
    by_any = -0.5 * (value.square() / total + total.log())
    # The other parameters hardly tell cameras apart.
    evidence = (_log_density_by(camera, value, noise) - by_any)[0]
    return float((evidence + SAME_LOG_ODDS + other_log_odds).sigmoid())


def _log_density_by(
    camera: MapCamera, value: Float[Tensor, "4"], noise: Float[Tensor, "4"]
) -> Float[Tensor, "4"]:
    """Return the logarithm of the density of an estimate if the image is from the map's camera, up to a constant."""
    total = camera.deviations.square() + noise
    return -0.5 * ((value - camera.correction).square() / total + total.log())


def probability_of_crop(
    part: ReprojectionFit,
    whole: ReprojectionFit,
    landmarks: LandmarkMap,
    log_ratio: float,
    open_camera: bool,
) -> float:
    """Return the probability that an image is a crop of a larger one.

    ``part`` is a fit whose principal point was free, with the prior ``CROPPED``, or ``ANY`` with an ``open_camera``; ``whole``
    is one whose focal length was free, with the prior ``NOMINAL``. ``log_ratio``: logarithm of their likelihood ratio, the
    first over the second. The prior odds are those among images whose intrinsics are wrong, even with an ``open_camera``: a
    principal point that is estimated needlessly costs little there.
    """
    value, noise = _estimate(part, landmarks)
    factor = part.calibration.focal_factor  # shares of the given focal length become those of the true one
    value, noise = value / factor, noise / factor**2
    cropped, right = (_log_density(prior, value, noise)[1:3].sum() for prior in (CROPPED, NOMINAL))
    against_right = float(cropped - right) + math.log(CROPS / (1 - WRONG_SHARE))
    factors = _log_occam_factor(part, ANY if open_camera else CROPPED) - _log_occam_factor(whole, NOMINAL)
    evidence = log_ratio + factors
    odds = min(against_right, evidence + math.log(CROPS / MISTAKES))
    return float(torch.tensor(odds, dtype=torch.float64).sigmoid())


def _log_occam_factor(fit: ReprojectionFit, prior: CalibrationPrior) -> float:
    """Return the log of a fit's Occam factor (MacKay 2003, ch. 28), up to a constant: prior density times posterior width.

    The likelihood of the fit times this factor is the evidence for its ``prior``, in Laplace's approximation. The width is that of
    independent parameters, and the pose, which is free in all fits, is left out.
    """
    scaled = _as_tensor(fit.calibration) / prior.deviations
    narrowed = (fit.calibration_deviations / prior.deviations).clamp(min=1e-6).log()
    return float((narrowed - 0.5 * scaled.square()).sum())


def unresolved_deviations(apparent: Float[Tensor, "4"], noise: Float[Tensor, "4"]) -> Float[Tensor, "4"]:
    """Return the standard deviations about zero of true corrections estimated as ``apparent`` with the variances ``noise``."""
    prior = torch.stack([part.deviations.square() for part, _ in MIXTURE])
    total = prior + noise
    weights = torch.softmax(_log_joint(MIXTURE, apparent, noise), dim=0)
    mean, variance = apparent * prior / total, prior * noise / total
    return (weights * (mean.square() + variance)).sum(0).sqrt()


def _log_joint(
    mixture: Mixture, apparent: Float[Tensor, "4"], noise: Float[Tensor, "4"]
) -> Float[Tensor, "parts 4"]:
    """Return for each parameter the logarithms of the joint densities of its estimate and the parts of a mixture."""
    return torch.stack([_log_density(part, apparent, noise) + math.log(share) for part, share in mixture])


def _log_density(
    prior: CalibrationPrior, apparent: Float[Tensor, "4"], noise: Float[Tensor, "4"]
) -> Float[Tensor, "4"]:
    """Return the logarithm of the density of each estimate with the variances ``noise``, up to a constant."""
    total = prior.deviations.square() + noise
    return -0.5 * (apparent.square() / total + total.log())


def _estimate(free: ReprojectionFit, landmarks: LandmarkMap) -> tuple[Float[Tensor, "4"], Float[Tensor, "4"]]:
    """Return the correction that fits best, and its variances."""
    value = _as_tensor(free.calibration)
    return value, free.calibration_deviations.square() + landmarks.calibration_scatter.square()


def _as_tensor(calibration: Calibration) -> Float[Tensor, "4"]:
    return torch.tensor(astuple(calibration), dtype=torch.float64)
