"""Whether the given intrinsics of a camera are wrong, judged by those that fit an image best."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.mapping.calibration import CALIBRATED, Calibration, CalibrationPrior
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.mapping.resection import ReprojectionFit

MISTAKEN, MISTAKES = CalibrationPrior(log_focal=0.05, shift=0.02, radial=0.05), 0.05
"""Standard deviations of intrinsics that are wrong, and the share of cameras whose intrinsics are."""
USUAL, USUALLY = CalibrationPrior(log_focal=0.01, shift=0.01, radial=0.01), 0.35
"""Standard deviations of intrinsics as many devices state them, and the share of cameras whose intrinsics are so: they belong to
another unit of the model, or to another focus and temperature.
"""


@dataclass(frozen=True, eq=False)
class Miscalibration:
    """How far the intrinsics that fit an image best are from the given ones, and whether these are wrong.

    Images of the map, whose intrinsics are right, seem to need corrections, too; their scatter is part of the noise.
    """

    apparent: Float[Tensor, "4"]  # the correction that fits best, in the order of ``Calibration``
    noise: Float[Tensor, "4"]  # standard deviations of that estimate by the noise of the keypoints
    probability: Float[Tensor, "4"]  # that the given parameter is wrong
    unresolved: Float[
        Tensor, "4"
    ]  # standard deviation of the true correction about zero, usual errors of cameras included

    @staticmethod
    def unknown() -> Miscalibration:
        """Return that of intrinsics that no image has been compared with."""
        zero = torch.zeros(4, dtype=torch.float64)
        return Miscalibration(zero, zero, zero, USUAL.deviations)

    @staticmethod
    def of(free: ReprojectionFit, landmarks: LandmarkMap) -> Miscalibration:
        """Judge by a fit in which the intrinsics were free."""
        value = torch.tensor(astuple(free.calibration), dtype=torch.float64)
        noise = free.calibration_deviations.square() + landmarks.calibration_scatter.square()
        right, wrong = (noise + prior.deviations.square() for prior in (CALIBRATED, MISTAKEN))
        log_ratio = 0.5 * (value.square() / right - value.square() / wrong + right.log() - wrong.log())
        log_odds = log_ratio + math.log(MISTAKES / (1 - MISTAKES))
        return Miscalibration(
            value, free.calibration_deviations, log_odds.sigmoid(), unresolved_deviations(value, noise)
        )

    @property
    def calibration(self) -> Calibration:
        """The correction that fits best."""
        return Calibration(*self.apparent.tolist())

    @property
    def deviations(self) -> Float[Tensor, "4"]:
        """The standard deviation of the true correction about zero."""
        return (CALIBRATED.deviations.square() + self.probability * self.apparent.square()).sqrt()

    @property
    def worst(self) -> tuple[int, float]:
        """The parameter that is most likely wrong, and the probability that it is."""
        number = int(self.probability.argmax())
        return number, float(self.probability[number])

    @property
    def sentence(self) -> str:
        """What the most suspect parameter should be."""
        number, _ = self.worst
        value = float(self.apparent[number])
        if number == 0:
            return f"a focal length {math.expm1(value):+.1%} from the given one"
        if number == 3:
            return f"a radial distortion {value:+.3f} from the given one"
        axis = "right" if number == 1 else "down"
        return f"a principal point {value:+.1%} of the focal length further {axis}"


def unresolved_deviations(apparent: Float[Tensor, "4"], noise: Float[Tensor, "4"]) -> Float[Tensor, "4"]:
    """Return the standard deviations about zero of the true corrections, seen as ``apparent`` with the variances ``noise``.

    The prior is a mixture: intrinsics are calibrated, off as usual, or wrong.
    """
    parts = ((CALIBRATED, 1 - USUALLY - MISTAKES), (USUAL, USUALLY), (MISTAKEN, MISTAKES))
    prior = torch.stack([part.deviations.square() for part, _ in parts])
    shares = torch.tensor([[share] for _, share in parts], dtype=prior.dtype)
    total = prior + noise
    log_density = -0.5 * (apparent.square() / total + total.log())
    weights = torch.softmax(log_density + shares.log(), dim=0)
    mean, variance = apparent * prior / total, prior * noise / total
    return (weights * (mean.square() + variance)).sum(0).sqrt()
