"""A set of Gaussians as stored in a file, before it becomes a field."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_gaussians.pieces import LEAST_ALPHA
from bidnerf_gaussians.quaternions import product
from bidnerf_gaussians.spherical_harmonics import rotated

COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}
"""Number of spherical harmonics up to each degree."""
LARGEST = 1e12
"""Scene units: largest coordinate and size of a Gaussian."""


@dataclass(frozen=True, eq=False)
class Gaussians:
    """The parameters of n Gaussians, in the terms of the original 3DGS code (Kerbl et al. 2023)."""

    means: Float[Tensor, "n 3"]  # scene units, world
    log_scales: Float[Tensor, "n 3"]  # logarithms of the standard deviations along the axes
    quaternions: Float[Tensor, "n 4"]  # w, x, y, z of the rotation from the axes to the world; not normalized
    logits: Float[Tensor, "n"]  # opacity is their sigmoid
    # coefficients of the colour's spherical harmonics, minus a colour of 0.5
    harmonics: Float[Tensor, "n k 3"]

    def __len__(self) -> int:
        return len(self.means)

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        return Gaussians(*(getattr(self, part.name)[index] for part in fields(self)))

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return next(degree for degree, count in COEFFICIENTS.items() if count == self.harmonics.shape[1])

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """Opacities, in [0, 1]."""
        return self.logits.sigmoid()

    def similar(self, scale: float, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> Gaussians:
        """Return the Gaussians transformed by ``x -> rotation @ (scale * x) + translation``; colours rotate with them."""
        R = rotation.double()
        means = (scale * self.means.double()) @ R.mT + translation.double()
        turn = SE3(R, translation).quaternion("wxyz").to(self.quaternions)
        is_turned = bool((R - torch.eye(3, dtype=torch.float64)).abs().max() > 1e-9)
        return Gaussians(
            means.float(),
            self.log_scales + float(torch.tensor(scale).log()),
            product(turn.expand_as(self.quaternions), self.quaternions) if is_turned else self.quaternions,
            self.logits,
            rotated(self.harmonics, R) if is_turned else self.harmonics,
        )


def cleaned(found: Gaussians, where: str) -> tuple[Gaussians, str]:
    """Return the Gaussians that can be rendered, and a text on those left out, which is empty if there are none.

    Raises ``InputError``, whose message begins with ``where``, if none is left.
    """
    if found.harmonics.shape[1] not in COEFFICIENTS.values():
        raise InputError(
            f"{found.harmonics.shape[1]} spherical harmonics",
            where=where,
            expected="1, 4, 9 or 16 (degree 0 to 3)",
        )
    finite = _finite(found)
    turned = found.quaternions.abs().amax(-1) > 1e-12
    kept = finite & turned & (found.logits.sigmoid() >= LEAST_ALPHA)
    left = {
        "with numbers that are not finite or too large": ~finite,
        "with a zero quaternion": finite & ~turned,
        "that are transparent": finite & turned & ~kept,
    }
    dropped = ", ".join(f"{int(rows.sum()):,} {what}" for what, rows in left.items() if bool(rows.any()))
    if not bool(kept.any()):
        what = f": {dropped}" if dropped else ""
        raise InputError(
            f"none of its {len(found):,} Gaussians can be rendered{what}",
            where=where,
            expected="at least one",
        )
    few = found if bool(kept.all()) else found[kept]
    return Gaussians(
        few.means.float(),
        few.log_scales.float(),
        torch.nn.functional.normalize(few.quaternions.float(), dim=-1),
        few.logits.float().clamp(max=14.0),  # where alpha is practically 1 in single precision
        few.harmonics.float(),
    ), dropped


def _finite(found: Gaussians) -> Bool[Tensor, "n"]:
    opaque = found.logits == torch.inf  # an opacity of 1, which some writers store
    finite = found.logits.isfinite() | opaque
    for value, most in (
        (found.means, LARGEST),
        (found.log_scales, torch.tensor(LARGEST).log().item()),
        (found.quaternions, LARGEST),
        (found.harmonics.flatten(1), LARGEST),
    ):
        finite = finite & (value.abs() <= most).all(-1)  # False for NaN
    return finite
