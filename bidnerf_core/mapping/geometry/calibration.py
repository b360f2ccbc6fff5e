"""Corrections of a camera's intrinsics, and how uncertain intrinsics are."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.errors import enumeration

PRINCIPAL_POINT = "a principal point "


@dataclass(frozen=True)
class Calibration:
    """A correction of given intrinsics, which may be estimated along with the pose."""

    log_focal: float = 0.0  # logarithm of the ratio of the true to the given focal length
    shift_u: float = 0.0  # of the principal point, as a share of the given focal length
    shift_v: float = 0.0
    radial: float = 0.0  # first coefficient of radial distortion, added to the given distortion

    @property
    def focal_factor(self) -> float:
        """Ratio of the true to the given focal length."""
        return math.exp(self.log_focal)

    def applied(self, given: Intrinsics) -> Intrinsics:
        """Return the corrected intrinsics; the given ones if there is nothing to correct."""
        if self == GIVEN:
            return given
        k1, *others = given.distortion or (0.0, 0.0, 0.0, 0.0)
        factor = self.focal_factor
        return replace(
            given, fx=given.fx * factor, fy=given.fy * factor, cx=given.cx + self.shift_u * given.fx,
            cy=given.cy + self.shift_v * given.fy, distortion=(k1 + self.radial, *others),
        )  # fmt: skip

    def pixels(self, flat: Float[Tensor, "m 2"], focal: float) -> Float[Tensor, "m 2"]:
        """Return where points on the plane z = 1 appear: pixels from the given principal point, at the given focal length."""
        bent = flat * (1 + self.radial * flat.square().sum(-1, keepdim=True))
        shift = torch.tensor([self.shift_u, self.shift_v], dtype=flat.dtype)
        return (bent * self.focal_factor + shift) * focal

    def undistorted(self, image: Float[Tensor, "m 2"], focal: Float[Tensor, "m"]) -> Float[Tensor, "m 2"]:
        """Return corrected observations on the plane z = 1, for observations made with the given intrinsics."""
        seen = (image - torch.tensor([self.shift_u, self.shift_v], dtype=image.dtype)) / self.focal_factor
        flat = seen
        for _ in range(8):  # fixed-point iteration as in OpenCV's undistortPoints
            flat = seen / (1 + self.radial * flat.square().sum(-1, keepdim=True))
        return flat

    @property
    def sentence(self) -> str:
        """The considerable parts of the correction, in words."""
        return (
            f"{enumeration(self.considerable)} than given"
            if self.considerable
            else "nearly the same as given"
        )

    @property
    def considerable(self) -> list[str]:
        """The parts of the correction that are larger than errors of a good calibration, in words."""
        sizes = torch.tensor(astuple(self), dtype=torch.float64).abs() / CALIBRATED.deviations
        large = (sizes > 2).tolist()
        found = [text for text, is_large in zip(self.parts, large, strict=True) if is_large]
        if large[1] and large[2]:  # one principal point
            down = found.pop(found.index(self.parts[2]))
            found[found.index(self.parts[1])] += f" and {down.removeprefix(PRINCIPAL_POINT)}"
        return found

    @property
    def parts(self) -> tuple[str, str, str, str]:
        """Each part of the correction in words, in the order of the fields."""
        longer, right, down, higher = (
            word if value >= 0 else opposite
            for value, word, opposite in (
                (self.log_focal, "longer", "shorter"),
                (self.shift_u, "right", "left"),
                (self.shift_v, "down", "up"),
                (self.radial, "higher", "lower"),
            )
        )
        return (
            f"a focal length {abs(self.focal_factor - 1):.1%} {longer}",
            f"{PRINCIPAL_POINT}{abs(self.shift_u):.1%} of the focal length further {right}",
            f"{PRINCIPAL_POINT}{abs(self.shift_v):.1%} of the focal length further {down}",
            f"a radial distortion {abs(self.radial):.3f} {higher}",
        )


GIVEN = Calibration()
"""Intrinsics as they are given."""


@dataclass(frozen=True)
class Stretch:
    """Factors of the given focal lengths: the image was resized to another shape, which its intrinsics do not reflect."""

    across: float = 1.0
    down: float = 1.0

    def applied(self, given: Intrinsics) -> Intrinsics:
        """Return the intrinsics of the stretched image."""
        return replace(given, fx=given.fx * self.across, fy=given.fy * self.down)

    def sentence(self, calibration: Calibration) -> str:
        """Return in words how a camera differs from the given one if its ``calibration`` is corrected too."""
        factor = self.across / self.down
        if factor == 1:
            return calibration.sentence
        how = f"{abs(factor - 1):.0%} {'wider' if factor > 1 else 'narrower'}"
        return f"{enumeration([f'an image {how}', *calibration.considerable])} than given"


UNSTRETCHED = Stretch()
"""No stretch: the shape is the one that the intrinsics state."""


@dataclass(frozen=True)
class CalibrationPrior:
    """Standard deviations of given intrinsics, in the units of ``Calibration``; a parameter with 0 is not estimated."""

    log_focal: float = 0.0
    shift: float = 0.0
    radial: float = 0.0

    @property
    def deviations(self) -> Float[Tensor, "4"]:
        """The standard deviations in the order of the fields of ``Calibration``."""
        return torch.tensor([self.log_focal, self.shift, self.shift, self.radial], dtype=torch.float64)


FIXED = CalibrationPrior()
"""Intrinsics that are not estimated."""
CALIBRATED = CalibrationPrior(log_focal=0.002, shift=0.002, radial=0.002)
"""Intrinsics from a good calibration."""
USUAL, USUALLY = CalibrationPrior(log_focal=0.01, shift=0.01, radial=0.01), 0.35
"""Standard deviations of intrinsics as many devices state them, and the share of cameras with such intrinsics: they belong to
another unit of the model, or to another focus and temperature.
"""
DOUBTED = CalibrationPrior(log_focal=0.005, shift=0.005, radial=0.005)
"""Intrinsics that are right as far as is known, of a camera whose other intrinsics are wrong."""
MISTAKEN, MISTAKES = CalibrationPrior(log_focal=0.05, shift=0.02, radial=0.05), 0.05
"""Standard deviations of intrinsics that are wrong, and the share of cameras with such intrinsics."""
CROPPED, CROPS = CalibrationPrior(log_focal=DOUBTED.log_focal, shift=0.1, radial=DOUBTED.radial), 0.02
"""Standard deviations of intrinsics that take the middle of a cropped image for its principal point, and their share."""
NOMINAL = CalibrationPrior(log_focal=0.2, shift=0.01, radial=0.03)
"""Intrinsics from EXIF or a field of view, without distortion."""
ANY = CalibrationPrior(log_focal=NOMINAL.log_focal, shift=CROPPED.shift, radial=NOMINAL.radial)
"""Intrinsics of which nothing is known except that the lens has the usual distortion; the image may be a crop."""
