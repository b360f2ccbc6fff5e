"""Rendered rays and their derivatives, by one backward pass per channel, for any differentiable field.

Rays are independent, so the gradient of a channel's sum over all rays, with respect to their origins and directions, contains the
gradient of every single ray. Four passes give all derivatives of an RGB-D rendering; on a GPU, one pass over four copies of the
rays suffices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.devices import may_wait
from bidnerf_core.fields import (
    HitField,
    RadianceField,
    Rays,
    RaySamples,
    Rendering,
    render,
    render_samples,
    rows_of,
)

LEAST_WEIGHT = 0.01
"""Rendering weight of a sample below which its derivatives are neglected: most samples lie in empty space."""
MOST_AT_ONCE = 2**18
"""Number of samples, including copies, up to which all channels are differentiated in one pass."""

Channels = Callable[[Rendering, Int[Tensor, "k"]], Float[Tensor, "k c"]]
"""Computes channels from the rendering of some of the rays, whose numbers are the second argument."""


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Channels of r rendered rays, and their gradients."""

    value: Float[Tensor, "r c"]
    by_origin: Float[Tensor, "r c 3"]
    by_direction: Float[Tensor, "r c 3"]


def differentiate(
    field: RadianceField, rays: Rays, background: tuple[float, float, float], channels: Channels
) -> Derivatives:
    """Render rays (r), and differentiate the channels of each by its origin and its direction."""
    every = torch.arange(len(rays.near), device=rays.near.device)
    has_hits, leaves = isinstance(field, HitField), _leaves(rays)
    # A field that computes hits is rendered once, since finding them takes nearly all of the time.
    with torch.set_grad_enabled(has_hits):
        rendering = render(field, _from(rays, leaves) if has_hits else rays, background)
        moving = channels(rendering, every)
    value, index, copies = moving.detach(), every, 1
    count = value.shape[-1]
    results = [leaf.new_zeros((len(every), count, 3)) for leaf in leaves]
    if not has_hits:
        kept = rendering.samples.valid & (rendering.weights > LEAST_WEIGHT)
        if may_wait(kept.device):
            index = kept.any(-1).nonzero()[:, 0]
            if len(index) == 0:
                return Derivatives(value, *results)
            samples = _packed(rendering.samples, kept, index)
        else:
            samples = replace(rendering.samples, valid=kept)
        # On a CPU, copies of the rays would only add computation. On a GPU, launches dominate the time of a pass unless
        # there are many samples.
        if kept.device.type != "cpu" and count * samples.valid.numel() <= MOST_AT_ONCE:
            copies = count
            samples = rows_of(samples, torch.arange(len(index), device=index.device).repeat(copies))
        repeated = index.repeat(copies)
        few = rows_of(rays, repeated)
        leaves = _leaves(few)
        with torch.enable_grad():
            moving = channels(render_samples(field, _from(few, leaves), samples, background), repeated)
    if not moving.requires_grad:  # no ray hits anything
        return Derivatives(value, *results)
    passes = [list(range(count))] if copies > 1 else [[channel] for channel in range(count)]
    with torch.enable_grad():
        parts = moving.unflatten(0, (copies, -1))
    for number, wanted in enumerate(passes, start=1):
        with torch.enable_grad():
            total = torch.stack([parts[copy, :, channel].sum() for copy, channel in enumerate(wanted)]).sum()
        gradients: tuple[Tensor | None, ...] = torch.autograd.grad(
            total, leaves, retain_graph=number < len(passes), allow_unused=True
        )
        for result, gradient in zip(results, gradients, strict=True):
            if gradient is not None:
                for channel, part in zip(wanted, gradient.chunk(copies), strict=True):
                    result[index, channel] = part
    return Derivatives(value, *results)


def _leaves(rays: Rays) -> list[Tensor]:
    return [part.detach().requires_grad_() for part in (rays.origins, rays.directions)]


def _from(rays: Rays, leaves: list[Tensor]) -> Rays:
    return replace(rays, origins=leaves[0], directions=leaves[1])


def _packed(samples: RaySamples, kept: Tensor, index: Int[Tensor, "k"]) -> RaySamples:
    """Return the kept samples of some rays, packed into rows that are as short as possible."""
    kept = kept[index]
    order = (~kept).sort(dim=-1, stable=True).indices[:, : int(kept.sum(-1).amax())]
    return RaySamples(
        *(part.gather(-1, order) for part in (samples.starts[index], samples.ends[index], kept))
    )
