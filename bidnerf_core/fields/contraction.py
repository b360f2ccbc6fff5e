"""Contraction of unbounded space (Barron et al. 2022, mip-NeRF 360, section 2).

Points within a unit of the origin stay in place, and all others are mapped into the shell between 1 and 2, so
that a field of bounded size models near things finely and distant ones coarsely. The norm is the largest
coordinate, as in nerfstudio: the contracted space is then a cube, which a grid fills.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


def contract_points(points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Return ``x`` where its norm is at most 1, and ``(2 - 1 / |x|) x / |x|`` elsewhere (eq. 10); every norm is below 2."""
    norm = points.abs().amax(-1, keepdim=True).clamp(min=1)
    return points * ((2 - 1 / norm) / norm)


@dataclass(frozen=True, eq=False)
class RaySpacing:
    """A coordinate along rays in which equal steps match the resolution of a contracted field (eq. 11).

    It is the distance (metres) up to ``exit``, where the ray leaves the uncontracted box, and ``exit + radius
    * x / (1 + x)`` beyond, with ``x`` the distance from there in units of ``radius``.
    """

    exit: Float[Tensor, "*r"]  # metres along the ray
    radius: float  # metres: half the side of the uncontracted cube; infinite without contraction

    def rows(self, numbers: Int[Tensor, "m"]) -> RaySpacing:
        """Return the spacing of the rays with these indices. ``exit`` must have a single dimension, (r,)."""
        return RaySpacing(self.exit.index_select(0, numbers), self.radius)

    def place(self, distance: Float[Tensor, "*r s"]) -> Float[Tensor, "*r s"]:
        """Return the coordinate at a distance along the ray (metres)."""
        if self.radius == float("inf"):
            return distance
        beyond = (distance - self.exit[..., None]).clamp(min=0)
        return torch.minimum(distance, self.exit[..., None]) + beyond / (1 + beyond / self.radius)

    def distance(self, place: Float[Tensor, "*r s"]) -> Float[Tensor, "*r s"]:
        """Return the distance (metres) at a coordinate, the inverse of ``place``."""
        if self.radius == float("inf"):
            return place
        beyond = (place - self.exit[..., None]).clamp(min=0)
        left = (1 - beyond / self.radius).clamp(min=torch.finfo(place.dtype).eps)
        return torch.minimum(place, self.exit[..., None]) + beyond / left
