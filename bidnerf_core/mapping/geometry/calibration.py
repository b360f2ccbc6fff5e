"""Corrections to a camera's intrinsics, and priors on them."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import enumeration

PRINCIPAL_POINT = "a principal point "
STRETCH_TOLERANCE = 0.02
"""Largest stretch (logarithm) that lens and landmark errors produce; beyond it, the image was resized."""


@dataclass(frozen=True)
class Calibration:
    """A correction to given intrinsics, which may be estimated along with the pose."""

    log_focal: float = 0.0  # logarithm of the ratio of the true to the given focal length
    shift_u: float = 0.0  # of the principal point, as a fraction of the given focal length
    shift_v: float = 0.0
    radial: float = 0.0  # first coefficient of radial distortion, added to the given distortion
    log_stretch: float = (
        0.0  # logarithm of the true fx / fy over the given fx / fy; not 0 if resized to another aspect ratio
    )

    @property
    def focal_factor(self) -> float:
        """Ratio of the true to the given focal length; for a stretched image, the geometric mean of both axes."""
        return math.exp(self.log_focal)

    @property
    def across_and_down(self) -> Float[Tensor, "2"]:
        """The ratios of the true to the given fx and fy."""
        logarithms = (self.log_focal + 0.5 * self.log_stretch, self.log_focal - 0.5 * self.log_stretch)
        return torch.tensor(logarithms, dtype=torch.float64).exp()

    def applied(self, given: Intrinsics) -> Intrinsics:
        """Return the corrected intrinsics; the given ones if there is nothing to correct."""
        if self == GIVEN:
            return given
        k1, *others = given.distortion or (0.0, 0.0, 0.0, 0.0)
        across, down = self.across_and_down.tolist()
        return replace(
            given, fx=given.fx * across, fy=given.fy * down, cx=given.cx + self.shift_u * given.fx,
            cy=given.cy + self.shift_v * given.fy, distortion=(k1 + self.radial, *others),
        )  # fmt: skip

    def pixels(self, flat: Float[Tensor, "m 2"], focal: float) -> Float[Tensor, "m 2"]:
        """Return the projections of points on the plane z = 1, in pixels from the given principal point."""
        bent = flat * (1 + self.radial * flat.square().sum(-1, keepdim=True))
        shift = torch.tensor([self.shift_u, self.shift_v], dtype=flat.dtype)
        return (bent * self.across_and_down.to(flat.dtype) + shift) * focal

    def undistorted(self, image: Float[Tensor, "m 2"]) -> Float[Tensor, "m 2"]:
        """Convert observations on the plane z = 1 from the given intrinsics to the corrected ones."""
        shift = torch.tensor([self.shift_u, self.shift_v], dtype=image.dtype)
        seen = (image - shift) / self.across_and_down.to(image.dtype)
        flat = seen
        for _ in range(8):  # fixed-point iteration as in OpenCV's undistortPoints
            flat = seen / (1 + self.radial * flat.square().sum(-1, keepdim=True))
        return flat

    @property
    def is_stretched(self) -> bool:
        """Whether the image was resized to another aspect ratio, which its intrinsics do not reflect."""
        return abs(self.log_stretch) > STRETCH_TOLERANCE

    @property
    def _focal_beside_stretch(self) -> float:
        """Logarithm of the change of focal length that remains after a stretch.

        An image resized along one axis keeps its focal length along the other, so the smallest change is the most probable.
        """
        if not self.is_stretched:
            return self.log_focal
        return min((self.log_focal + share * self.log_stretch for share in (0, -0.5, 0.5)), key=abs)

    def compared(self, stated: str) -> str:
        """Return the significant parts of the correction as a phrase; ``stated`` is "given" or "assumed"."""
        return (
            f"{enumeration(self.considerable)} than {stated}"
            if self.considerable
            else f"nearly the same as {stated}"
        )

    @property
    def considerable(self) -> list[str]:
        """Phrases for the parts of the correction that exceed the errors of a good calibration."""
        values = [self._focal_beside_stretch, *astuple(self)[1:]]
        sizes = torch.tensor(values, dtype=torch.float64).abs() / CALIBRATED.deviations
        large = [*(sizes[:4] > 2).tolist(), self.is_stretched]
        found = [text for text, is_large in zip(self.parts, large, strict=True) if is_large]
        if large[1] and large[2]:  # one principal point
            down = found.pop(found.index(self.parts[2]))
            found[found.index(self.parts[1])] += f" and {down.removeprefix(PRINCIPAL_POINT)}"
        return found[-1:] + found[:-1] if large[4] else found

    @property
    def parts(self) -> tuple[str, str, str, str, str]:
        """A phrase for each part of the correction, in the order of the fields."""
        longer, right, down, higher, wider = (
            word if value >= 0 else opposite
            for value, word, opposite in (
                (self._focal_beside_stretch, "longer", "shorter"),
                (self.shift_u, "right", "left"),
                (self.shift_v, "down", "up"),
                (self.radial, "higher", "lower"),
                (self.log_stretch, "wider", "narrower"),
            )
        )
        return (
            f"a focal length {abs(math.exp(self._focal_beside_stretch) - 1):.1%} {longer}",
            f"{PRINCIPAL_POINT}{abs(self.shift_u):.1%} of the focal length further {right}",
            f"{PRINCIPAL_POINT}{abs(self.shift_v):.1%} of the focal length further {down}",
            f"a radial distortion {abs(self.radial):.3f} {higher}",
            f"an image {abs(math.exp(self.log_stretch) - 1):.0%} {wider}",
        )


GIVEN = Calibration()
"""No correction: the intrinsics as given."""


@dataclass(frozen=True)
class CalibrationPrior:
    """Standard deviations of given intrinsics, in the units of ``Calibration``; parameters with 0 are not estimated."""

    log_focal: float = 0.0
    shift: float = 0.0
    radial: float = 0.0
    stretch: float = 0.0

    @property
    def deviations(self) -> Float[Tensor, "5"]:
        """The standard deviations in the order of the fields of ``Calibration``."""
        parts = [self.log_focal, self.shift, self.shift, self.radial, self.stretch]
        return torch.tensor(parts, dtype=torch.float64)


FIXED = CalibrationPrior()
"""Intrinsics that are not estimated."""
CALIBRATED = CalibrationPrior(log_focal=0.002, shift=0.002, radial=0.002, stretch=0.001)
"""Intrinsics from a good calibration."""
RIGHT = CalibrationPrior(log_focal=0.005, shift=0.005, radial=0.005, stretch=0.001)
"""Intrinsics believed to be right: most are well calibrated, but a few are off in some parameter."""
USUALLY, MISTAKES, CROPS = 0.35, 0.05, 0.02
"""Fractions of cameras whose stated intrinsics are as in ``USUAL``, wrong, or from before a crop; the rest are calibrated."""
USUAL = CalibrationPrior(log_focal=0.01, shift=0.01, radial=0.01, stretch=0.001)
"""Intrinsics as many devices state them: from another unit of the model, or at another focus or temperature."""
MISTAKEN = CalibrationPrior(log_focal=0.05, shift=0.02, radial=0.05, stretch=0.001)
"""Intrinsics that are wrong."""
CROPPED = replace(USUAL, shift=0.1)
"""Intrinsics that take the middle of a cropped image for its principal point."""
NOMINAL = CalibrationPrior(log_focal=0.2, shift=0.01, radial=0.03)
"""Intrinsics from EXIF or a field of view, without distortion."""
ANY = replace(NOMINAL, shift=CROPPED.shift)
"""Unknown intrinsics of a lens with ordinary distortion; the image may be a crop."""
STRETCHED = replace(ANY, stretch=ANY.log_focal)
"""Unknown intrinsics of an image that may also have been resized to another aspect ratio."""
