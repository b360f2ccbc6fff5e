"""Sphere tracing of a baked surface (Hart 1996): where rays hit it, or how closely they pass it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.devices import constant, may_wait
from bidnerf_core.mapping.surface.surface_map import SurfaceMap


@dataclass(frozen=True, eq=False)
class Cast:
    """The point at which each ray hit the surface or, if it missed, came closest to it in angle."""

    met: Bool[Tensor, "r"]
    along: Float[Tensor, "r"]  # metres along the ray to that point
    index: Int[Tensor, "r"]  # the surfel nearest to it


def cast(
    surface: SurfaceMap,
    origins: Float[Tensor, "r 3"],
    directions: Float[Tensor, "r 3"],
    steps: int = 36,
    radius: float | None = None,
) -> Cast:
    """Trace rays (metres, world; unit directions) until they are within ``radius`` (metres; by default the surfels' radius)
    of a surfel. A step is as long as the clearance, but at least a cell.

    For a ray that misses the grid, the closest point is that nearest to the grid's centre. Rays must be on the surface's
    device. Where the host must not wait for the device, finished rays are traced to the end, without effect.
    """
    radius = surface.surfel_radius if radius is None else radius
    rays, cell = surface.grid.rays(origins, directions), surface.grid.cell
    best = ((constant(surface.grid.centre, origins) - origins) * directions).sum(-1).clamp(min=0)
    index = surface.nearest(rays.at(best[:, None])[:, 0])
    least, met = torch.full_like(best, torch.inf), torch.zeros_like(best, dtype=torch.bool)
    left, on = torch.arange(len(best), device=best.device), rays.near < rays.far
    here, o, d, far = rays.near, origins, directions, rays.far
    for step in range(steps):
        # Rays that have hit the surface or left the grid are dropped every six steps.
        if step % 6 == 0 and may_wait(best.device):
            left, here, o, d, far = left[on], here[on], o[on], d[on], far[on]
            on = torch.ones_like(left, dtype=torch.bool)
            if not len(left):
                break
        points = o + here[:, None] * d
        nearest = surface.nearest(points)
        clearance = torch.linalg.vector_norm(points - surface.surfels.positions[nearest], dim=-1)
        hit = clearance < radius
        angle = torch.where(hit, 0, clearance / here.clamp(min=cell))
        closer = on & (angle < least[left])
        for values, new in ((least, angle), (best, here), (index, nearest)):
            values[left] = torch.where(closer, new, values[left])
        met[left] |= on & hit
        here = torch.where(hit, here, here + clearance.clamp(min=cell))
        if step % 6 == 5:
            on = on & (here < far) & ~hit
    return Cast(met, best, index)


def trace(
    surface: SurfaceMap, origins: Float[Tensor, "*r 3"], directions: Float[Tensor, "*r 3"], steps: int = 48
) -> Float[Tensor, "*r"]:
    """Return the distance (metres) at which each ray comes within a cell of the surface inside the grid.

    It is infinite if the ray never does. ``directions`` are unit vectors.
    """
    shape, (origins, directions) = directions.shape[:-1], (x.reshape(-1, 3) for x in (origins, directions))
    found = cast(surface, origins, directions, steps, surface.grid.cell)
    within = found.met & (found.along < surface.grid.rays(origins, directions).far)
    return torch.where(within, found.along, torch.inf).reshape(shape)
