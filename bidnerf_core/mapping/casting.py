"""Looking at a baked surface along rays: what each meets, or how closely it passes by."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.field import SceneBounds
from bidnerf_core.mapping.surface_map import SurfaceMap

ROUND = 6
"""Steps between which rays that are done are put aside."""


@dataclass(frozen=True, eq=False)
class Cast:
    """Where each of r rays met the surface, or came closest to it for its distance."""

    met: Bool[Tensor, "r"]
    along: Float[Tensor, "r"]  # metres along the ray to there
    index: Int[Tensor, "r"]  # the surfel there


def cast(
    surface: SurfaceMap, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"], steps: int = 36
) -> Cast:
    """Sphere tracing (Hart 1996) that remembers the least clearance, as an angle. ``directions`` are unit.

    A ray that passes the grid by is said to come closest where it is nearest to the grid's middle.
    """
    x, y, z = (
        low + size * surface.cell for low, size in zip(surface.lower, surface.nearest.shape, strict=True)
    )
    rays = SceneBounds(surface.lower, (x, y, z), 0.0, 1e9).rays(origins, directions)
    middle = origins.new_tensor([(a + b) / 2 for a, b in zip(surface.lower, (x, y, z), strict=True)])
    best = ((middle - origins) * directions).sum(-1).clamp(min=0)
    index = surface.touch(rays.at(best[:, None])[:, 0].nan_to_num())
    least, met = torch.full_like(best, torch.inf), torch.zeros_like(best, dtype=torch.bool)
    left = (rays.near < rays.far).nonzero()[:, 0]
    here, o, d, far = rays.near[left], origins[left], directions[left], rays.far[left]
    for step in range(steps):
        points = o + here[:, None] * d
        touched = surface.touch(points)
        clear = torch.linalg.vector_norm(points - surface.surfels.positions[touched], dim=-1)
        hit = clear < surface.reach
        angle = torch.where(hit, 0, clear / here.clamp(min=surface.cell))
        closer = angle < least[left]
        which = left[closer]
        least[which], best[which], index[which] = angle[closer], here[closer], touched[closer]
        met[left[hit]] = True
        here = torch.where(hit, here, here + clear.clamp(min=surface.cell))
        if step % ROUND == ROUND - 1:
            on = (here < far) & ~hit
            left, here, o, d, far = left[on], here[on], o[on], d[on], far[on]
            if not len(left):
                break
    return Cast(met, best, index)
