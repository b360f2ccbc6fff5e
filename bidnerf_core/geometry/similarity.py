"""Similarity transforms (rotation, translation and scale) between corresponding points."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry.se3 import SE3


@dataclass(frozen=True, eq=False)
class Similarity:
    """``x -> T.apply(scale * x)``."""

    scale: float  # target units per source unit
    T_target_source: SE3  # applied after scaling

    @property
    def is_identity(self) -> bool:
        """Whether it maps every point to itself."""
        matrix = self.T_target_source.matrix()
        return self.scale == 1 and bool((matrix == torch.eye(4).to(matrix)).all())

    def apply(self, points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
        return self.T_target_source.apply(self.scale * points)


FARTHEST_CAMERA = 1e12
"""Largest coordinate of a camera; squares of larger ones lose all precision."""


def fit_similarity(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Similarity:
    """Return the similarity that maps ``source`` to ``target`` in the least-squares sense (Umeyama 1991, eqs.
    34 to 43).

    If the points are collinear, the rotation about their line is arbitrary, but the scale is still
    determined. Raises ``InputError`` if all points of either set coincide.
    """
    source, target = source.double(), target.double()
    largest = max((float(x.abs().max()) for x in (source, target) if x.numel()), default=0.0)
    if not largest <= FARTHEST_CAMERA:
        raise InputError(
            f"a point is {largest:g} away from the origin", expected=f"at most {FARTHEST_CAMERA:g}"
        )
    if len(source) < 2 or spread(source) == 0 or spread(target) == 0:
        raise InputError(f"{len(source)} pairs of points", expected="2 or more distinct ones")
    from_mean, to_mean = source - source.mean(0), target - target.mean(0)
    u, values, vh = torch.linalg.svd(to_mean.mT @ from_mean / len(source))  # eqs. 38, 39
    sign = torch.ones_like(values)
    sign[2] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vh))  # eq. 43: no reflection
    rotation = (u * sign) @ vh  # eq. 40
    scale = float((values * sign).sum() / from_mean.square().sum(-1).mean())  # eq. 42
    if not scale > 0:
        raise InputError(
            f"{len(source)} pairs of points, but no similarity maps one set to the other even roughly"
        )
    translation = target.mean(0) - scale * rotation @ source.mean(0)  # eq. 41
    return Similarity(scale, SE3(rotation, translation))


def spread(points: Float[Tensor, "n 3"]) -> float:
    """Return the root mean square distance from the mean, or 0 if all points coincide up to rounding."""
    found = float((points - points.mean(0)).square().sum(-1).mean().sqrt())
    return found if found > 1e-12 * float(points.abs().amax()) else 0.0
