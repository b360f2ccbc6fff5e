"""Residuals of rendered rays and their Jacobian, by one backward pass per channel, for any differentiable field.

Rays are independent, so the gradient of a channel's sum over all rays, with respect to their origins and directions, contains the
gradient of every single ray. Four passes give the whole Jacobian of an RGB-D objective; on a GPU, one pass over four copies of
the rays suffices.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.devices import may_wait
from bidnerf_core.fields import (
    HitField,
    Observations,
    RadianceField,
    Rays,
    RaySamples,
    Rendering,
    Residual,
    render,
    render_samples,
    rows_of,
)
from bidnerf_core.geometry import SE3

MOST_AT_ONCE = 2**18
"""Number of samples, including copies, up to which all channels are differentiated in one pass."""

BackgroundColour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Linearization:
    """The residuals of n rays from each of h poses, and their Jacobian with respect to the pose."""

    residuals: Float[Tensor, "h n c"]
    rgb: Float[Tensor, "h n 3"]  # rendered
    steepness: Float[Tensor, "h n c"]  # norm of the gradient with respect to the ray's origin, per metre
    jacobian: Float[Tensor, "h n c 6"]  # with respect to a right update at the pivot: translation, rotation


def linearize(
    field: RadianceField,
    rays: Rays,
    observed: Observations,
    residual: Residual,
    T_world_pivot: SE3,
    background: BackgroundColour,
    least_weight: float = 0.0,
    channels: tuple[int, ...] | None = None,
) -> Linearization:
    """Render ``rays`` (h n), which move with the pivots (h), and differentiate their residuals against ``observed`` (n).

    Samples with a rendering weight below ``least_weight`` contribute to the rendering, but not to its derivative: most of them lie
    in empty space, and derivatives take nearly all of the time. ``channels`` are those to differentiate, by default all; the
    Jacobian of the others is 0.
    """
    flat, shape = flattened(rays), rays.near.shape
    repeated = observed.repeated(shape[0])
    has_hits = isinstance(field, HitField)
    with torch.set_grad_enabled(has_hits):
        # A field that finds ray hits is rendered once, since finding them takes nearly all of the time.
        leaves = [part.detach().requires_grad_(has_hits) for part in (flat.origins, flat.directions)]
        rendering = render(field, replace(flat, origins=leaves[0], directions=leaves[1]), background)
    with torch.no_grad():
        # Rendered and measured colours nearly cancel at the solution, so their difference is computed in float64.
        precise = replace(rendering, rgb=rendering.rgb.double())
        residuals = residual(precise, replace(repeated, rgb=repeated.rgb.double()))
    count = residuals.shape[-1]
    wanted = tuple(range(count)) if channels is None else channels
    if has_hits:
        gradients = _gradients_by(leaves, rendering, repeated, residual, wanted, count)
    else:
        kept = rendering.samples.valid
        if least_weight > 0:
            kept = kept & (rendering.weights > least_weight)
        gradients = _ray_gradients(
            field, flat, repeated, residual, rendering.samples, kept, background, wanted, count
        )
    by_origin, by_direction = (part.reshape(*shape, count, 3) for part in gradients)
    jacobian = _by_update(rays, T_world_pivot, by_origin, by_direction)
    steepness = torch.linalg.vector_norm(by_origin, dim=-1)
    return Linearization(
        residuals.reshape(*shape, count), rendering.rgb.detach().reshape(*shape, 3), steepness, jacobian
    )


def _gradients_by(
    leaves: list[Tensor], rendering: Rendering, observed: Observations, residual: Residual, channels: tuple[int, ...],
    count: int,
) -> tuple[Float[Tensor, "r c 3"], Float[Tensor, "r c 3"]]:  # fmt: skip
    """Return the gradients of each ray's residuals with respect to ``leaves``, the rendered origins and directions."""
    results = [leaf.new_zeros((len(leaf), count, 3)) for leaf in leaves]
    if not rendering.rgb.requires_grad:  # no ray hits anything
        return results[0], results[1]
    with torch.enable_grad():
        found = residual(rendering, observed)
    for channel in channels:
        gradients: tuple[Tensor | None, ...] = torch.autograd.grad(
            found[:, channel].sum(), leaves, retain_graph=channel != channels[-1], allow_unused=True
        )
        for result, gradient in zip(results, gradients, strict=True):
            if gradient is not None:
                result[:, channel] = gradient
    return results[0], results[1]


def flattened(rays: Rays) -> Rays:
    """Return rays of shape (h n) along one axis."""
    parts = (rays.origins, rays.directions, rays.near, rays.far)
    origins, directions, near, far = (part.flatten(0, 1) for part in parts)
    return Rays(origins, directions, near, far)


def _ray_gradients(
    field: RadianceField, rays: Rays, observed: Observations, residual: Residual, samples: RaySamples,
    kept: Bool[Tensor, "r s"], background: BackgroundColour, channels: tuple[int, ...], count: int,
) -> tuple[Float[Tensor, "r c 3"], Float[Tensor, "r c 3"]]:  # fmt: skip
    """Return the gradients of each ray's residuals with respect to its origin and direction, from the ``kept`` samples."""
    results = [rays.origins.new_zeros((len(rays.near), count, 3)) for _ in range(2)]
    if may_wait(kept.device):
        busy = kept.any(-1).nonzero()[:, 0]
        samples = _gathered(samples, kept, busy) if len(busy) else samples
    else:
        busy = torch.arange(len(kept), device=kept.device)
        samples = replace(samples, valid=kept)
    if len(busy) == 0 or not channels:
        return results[0], results[1]
    copies = len(channels) if _all_at_once(samples, len(channels)) else 1
    if copies > 1:
        samples = rows_of(samples, torch.arange(len(busy), device=busy.device).repeat(copies))
    few, seen = rows_of(rays, busy.repeat(copies)), observed[busy.repeat(copies)]
    leaves = [part.detach().requires_grad_() for part in (few.origins, few.directions)]
    moving = replace(few, origins=leaves[0], directions=leaves[1])
    rendering: Rendering = render_samples(field, moving, samples, background)
    found = residual(rendering, seen).unflatten(0, (copies, -1))
    # Each pass differentiates one channel of each copy of the rays.
    passes = [channels] if copies > 1 else [(channel,) for channel in channels]
    for number, wanted in enumerate(passes, start=1):
        total = sum((found[copy, :, c].sum() for copy, c in enumerate(wanted)), start=found.new_zeros(()))
        gradients: tuple[Tensor | None, ...] = torch.autograd.grad(
            total, leaves, retain_graph=number < len(passes), allow_unused=True
        )
        for result, gradient in zip(results, gradients, strict=True):
            if gradient is None:
                continue
            for channel, part in zip(wanted, gradient.chunk(copies), strict=True):
                result[busy, channel] = part
    return results[0], results[1]


def _all_at_once(samples: RaySamples, channels: int) -> bool:
    """Return whether to differentiate all channels in one pass over as many copies of the rays.

    On a CPU, this would only add computation. On a GPU, the launch dominates the time of a pass unless there are many samples.
    """
    return samples.valid.device.type != "cpu" and channels * samples.valid.numel() <= MOST_AT_ONCE


def _gathered(samples: RaySamples, kept: Bool[Tensor, "r s"], rays: Tensor) -> RaySamples:
    """Return the kept samples of some rays, packed into rows that are as short as possible."""
    kept = kept[rays]
    order = (~kept).sort(dim=-1, stable=True).indices[:, : int(kept.sum(-1).amax())]
    parts = (samples.starts[rays], samples.ends[rays], kept)
    return RaySamples(*(part.gather(-1, order) for part in parts))


def _by_update(
    rays: Rays,
    T_world_pivot: SE3,
    by_origin: Float[Tensor, "h n c 3"],
    by_direction: Float[Tensor, "h n c 3"],
) -> Float[Tensor, "h n c 6"]:
    """Apply the chain rule to ``T exp(xi)`` at the pivot: ``do = R rho + R phi x (o - c)`` and ``dv = R phi x v``."""
    T = T_world_pivot.to(rays.origins)
    arm = (rays.origins - T.translation[:, None])[:, :, None]
    turning = torch.linalg.cross(arm.expand_as(by_origin), by_origin) + torch.linalg.cross(
        rays.directions[:, :, None].expand_as(by_direction), by_direction
    )
    return torch.cat([part @ T.rotation[:, None] for part in (by_origin, turning)], -1)
