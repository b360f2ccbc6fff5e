"""What rays see and how that changes with the pose: one backward pass a channel, however many rays and poses there are.

Rays do not know of each other, so the derivative of a channel's sum over all rays by their origins and directions holds
every ray's own. Four passes give the whole Jacobian of an RGB-D objective, of any field that has reverse-mode derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.field import RadianceField, Rays, RaySamples
from bidnerf_core.rendering import Rendering, render_samples
from bidnerf_core.se3 import SE3

Background = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Linearization:
    """What each of n rays sees from each of h poses: red, green, blue and misfit of distance; and how that changes."""

    seen: Float[Tensor, "h n 4"]
    steepness: Float[Tensor, "h n 4"]  # length of the derivative by the ray's origin, per metre
    jacobian: Float[Tensor, "h n 4 6"]  # by a right update at the pivot: translation, rotation


def linearize(
    field: RadianceField,
    rays: Rays,
    distance: Float[Tensor, "n"],
    miss: float,
    T_world_pivot: SE3,
    background: Background,
    least_weight: float = 0.0,
    channels: tuple[int, ...] = (0, 1, 2, 3),
) -> Linearization:
    """Render ``rays`` (h n), which hang on the pivots (h), and differentiate what they see.

    ``least_weight``: samples of less rendering weight count for what is seen, but not for its derivative; most of them
    are air, and nearly all of the time goes into derivatives. 0: all count.
    ``distance`` (metres) is what was measured along each ray, 0 where nothing was; a ray that meets nothing counts as
    ``miss`` metres too far. ``channels``: which are differentiated; the Jacobian of the others is 0.
    """
    flat = flattened(rays)
    where = distance.expand(rays.near.shape).flatten()
    with torch.no_grad():
        rendering = render_samples(field, flat, field.sampler(flat), background)
    kept = rendering.samples.valid
    if least_weight > 0:
        kept = kept & (rendering.weights > least_weight)
    by_origin, by_direction = _ray_gradients(
        field, flat, where, miss, rendering.samples, kept, background, channels
    )
    by_origin, by_direction = (part.reshape(*rays.near.shape, 4, 3) for part in (by_origin, by_direction))
    jacobian = _by_update(rays, T_world_pivot, by_origin, by_direction)
    seen = _channels(rendering, where, miss).reshape(*rays.near.shape, 4)
    return Linearization(seen, torch.linalg.vector_norm(by_origin, dim=-1), jacobian)


def flattened(rays: Rays) -> Rays:
    """Rays of one axis, from (h n)."""
    parts = (rays.origins, rays.directions, rays.near, rays.far)
    origins, directions, near, far = (part.flatten(0, 1) for part in parts)
    return Rays(origins, directions, near, far)


def _channels(rendering: Rendering, distance: Float[Tensor, "r"], miss: float) -> Float[Tensor, "r 4"]:
    """Colour, and ``sum_i w_i (t_i - d) + (1 - sum_i w_i) miss``: how far what is met is behind what was measured.

    As if whatever goes by met something ``miss`` metres too far. The plain difference, ``sum_i w_i t_i - d``, leaps by
    the whole distance at every edge, and derivatives of leaps lead nowhere.
    """
    misfit = rendering.distance - rendering.opacity * distance + (1 - rendering.opacity) * miss
    return torch.cat([rendering.rgb, misfit[..., None]], -1)


def _ray_gradients(
    field: RadianceField, rays: Rays, distance: Float[Tensor, "r"], miss: float, samples: RaySamples, kept: Bool[Tensor, "r s"], background: Background,
    channels: tuple[int, ...],
) -> tuple[Float[Tensor, "r 4 3"], Float[Tensor, "r 4 3"]]:  # fmt: skip
    """Derivatives of what each ray sees by its origin and by its direction, from the ``kept`` samples."""
    results = [rays.origins.new_zeros((len(rays.near), 4, 3)) for _ in range(2)]
    busy = kept.any(-1).nonzero()[:, 0]
    if len(busy) == 0 or not channels:
        return results[0], results[1]
    leaves = [part[busy].detach().requires_grad_() for part in (rays.origins, rays.directions)]
    few = Rays(leaves[0], leaves[1], rays.near[busy], rays.far[busy])
    seen = _channels(
        render_samples(field, few, _gathered(samples, kept, busy), background), distance[busy], miss
    )
    for channel in channels:
        gradients = torch.autograd.grad(
            seen[:, channel].sum(), leaves, retain_graph=channel != channels[-1], allow_unused=True
        )
        for result, gradient in zip(results, gradients, strict=True):
            if gradient is not None:
                result[busy, channel] = gradient
    return results[0], results[1]


def _gathered(samples: RaySamples, kept: Bool[Tensor, "r s"], rays: Tensor) -> RaySamples:
    """The kept samples of some rays, moved to the front of rows that are as short as can be."""
    kept = kept[rays]
    order = (~kept).sort(dim=-1, stable=True).indices[:, : int(kept.sum(-1).amax())]
    parts = (samples.starts[rays], samples.ends[rays], kept)
    return RaySamples(*(part.gather(-1, order) for part in parts))


def _by_update(
    rays: Rays,
    T_world_pivot: SE3,
    by_origin: Float[Tensor, "h n 4 3"],
    by_direction: Float[Tensor, "h n 4 3"],
) -> Float[Tensor, "h n 4 6"]:
    """The chain to ``T exp(xi)`` at the pivot: ``do = R rho + R phi x (o - c)`` and ``dv = R phi x v``."""
    T = T_world_pivot.to(rays.origins)
    arm = (rays.origins - T.translation[:, None])[:, :, None]
    turning = torch.linalg.cross(arm.expand_as(by_origin), by_origin) + torch.linalg.cross(
        rays.directions[:, :, None].expand_as(by_direction), by_direction
    )
    return torch.cat([part @ T.rotation[:, None] for part in (by_origin, turning)], -1)
