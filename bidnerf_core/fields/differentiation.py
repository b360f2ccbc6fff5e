"""Rendered rays and their derivatives, from the derivatives of the field at the rays' samples.

With features f_i of the samples (colours, distances), weights w_i and a background b, a channel of a ray is
``C = sum_i w_i f_i + (1 - sum_i w_i) b``. Its derivative with respect to the density of a sample of length l_i needs no backward pass:
``dC / dsigma_i = l_i (T_i+1 f_i - sum_j>i w_j f_j - T_end b)``, where T_i+1 is the share of the light that passes sample i.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import may_wait
from bidnerf_core.fields.contract import HitField, RadianceField, Rays, derivatives_of
from bidnerf_core.fields.rendering import Rendering, query_samples, render, render_values

LEAST_WEIGHT = 0.01
"""Rendering weight of a sample below which its derivatives are neglected: most samples lie in empty space."""
Derivatives = tuple[Float[Tensor, "r c"], Float[Tensor, "r c 3"], Float[Tensor, "r c 3"]]
"""Channels of r rendered rays, and their gradients with respect to the rays' origins and directions."""


def channels(rendering: Rendering, measured: Float[Tensor, "r"] | None, miss: float) -> Float[Tensor, "r c"]:
    """Return rendered colours and, with ``measured`` distances d (metres; 0: none), also ``sum_i w_i (t_i - d) + (1 - sum_i w_i) miss``.

    The fraction of a ray that passes through the scene counts as if it hit something ``miss`` metres beyond d: a rendered distance of 0
    would jump at silhouettes, where its derivative is of no use.
    """
    if measured is None:
        return rendering.rgb
    difference = rendering.distance - rendering.opacity * measured + (1 - rendering.opacity) * miss
    return torch.cat([rendering.rgb, torch.where(measured > 0, difference, 0)[:, None]], -1)


def differentiate(
    field: RadianceField,
    rays: Rays,
    background: tuple[float, float, float],
    measured: Float[Tensor, "r"] | None = None,
    miss: float = 0.0,
) -> Derivatives:
    """Render rays (r), and differentiate their ``channels`` with respect to the ray origins and directions."""
    if isinstance(field, HitField):
        return _differentiate_hits(field, rays, background, measured, miss)
    samples = field.sampler(rays)
    values = query_samples(field, rays, samples)
    rendering = render_values(values, samples, background)
    matters = (rendering.weights > LEAST_WEIGHT).reshape(-1)
    # Where the host must not wait to count them, all samples are passed on, with those that matter marked.
    index = matters.nonzero()[:, 0] if may_wait(matters.device) else None

    def chosen(part: Float[Tensor, "r s *f"]) -> Float[Tensor, "k *f"]:
        flat = part.flatten(0, 1)
        return flat if index is None else flat.index_select(0, index)

    middles = chosen(samples.middles)
    if index is None:
        origins, directions = (
            part[:, None].expand(*samples.valid.shape, 3).flatten(0, 1) for part in (rays.origins, rays.directions)
        )
    else:
        ray = index // max(samples.valid.shape[-1], 1)
        origins, directions = (part.index_select(0, ray) for part in (rays.origins, rays.directions))
    positions = origins + middles[:, None] * directions
    jacobian = derivatives_of(field, positions, directions, matters if index is None else None)
    seen, weights, features = channels(rendering, measured, miss), rendering.weights, values.rgb
    if measured is not None:
        difference = torch.where(measured[:, None] > 0, samples.middles - measured[:, None], 0)
        features = torch.cat([features, difference[..., None]], -1)
    length = samples.ends - samples.starts
    passed = torch.exp(-(torch.where(samples.valid, values.density * length, 0)).cumsum(-1))
    behind = seen[:, None] - (weights[..., None] * features).cumsum(1)
    steep = chosen(length[..., None] * (passed[..., None] * features - behind))
    share = chosen(weights)[:, None, None]
    if index is None:
        steep, share = torch.where(matters[:, None], steep, 0), torch.where(matters[:, None, None], share, 0)

    def along(by: Float[Tensor, "k 4 3"]) -> Float[Tensor, "k c 3"]:
        found = steep[..., None] * by[:, :1]
        colours = found[:, :3] + share * by[:, 1:]
        return colours if measured is None else torch.cat([colours, found[:, 3:]], 1)

    by_position = along(jacobian.by_position)
    by_direction = middles[:, None, None] * by_position + along(jacobian.by_direction)
    if index is None:
        sums = [part.unflatten(0, samples.valid.shape).sum(1) for part in (by_position, by_direction)]
    else:
        sums = [
            part.new_zeros(len(rays.near), *part.shape[1:]).index_add_(0, ray, part)
            for part in (by_position, by_direction)
        ]
    return seen, sums[0], sums[1]


def _differentiate_hits(
    field: HitField,
    rays: Rays,
    background: tuple[float, float, float],
    measured: Float[Tensor, "r"] | None,
    miss: float,
) -> Derivatives:
    """Differentiate with one backward pass per channel: the gradient of the channel's sum over rays holds the gradients of all rays."""
    leaves = [part.detach().requires_grad_() for part in (rays.origins, rays.directions)]
    with torch.enable_grad():
        rendering = render(field, replace(rays, origins=leaves[0], directions=leaves[1]), background)
        value = channels(rendering, measured, miss)
        sums = value.sum(0).unbind()
    gradients = [
        torch.autograd.grad(total, leaves, retain_graph=True, materialize_grads=True)
        if total.requires_grad  # false if no ray hits anything
        else [torch.zeros_like(leaf) for leaf in leaves]
        for total in sums
    ]
    by_origin, by_direction = (torch.stack(parts, 1) for parts in zip(*gradients, strict=True))
    return value.detach(), by_origin, by_direction
