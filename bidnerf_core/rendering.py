"""Volume rendering (Mildenhall et al. 2020, eq. 3; BID-NeRF, eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.constants import constant
from bidnerf_core.field import FieldValues, RadianceField, Rays, RaySamples, SceneBounds
from bidnerf_core.se3 import SE3
from bidnerf_core.waiting import may_wait


@dataclass(frozen=True, eq=False)
class Rendering:
    """Colour, distance and opacity of each ray."""

    rgb: Float[Tensor, "*r 3"]
    distance: Float[Tensor, "*r"]  # sum of weight times distance, metres: not divided by the opacity
    opacity: Float[Tensor, "*r"]  # 0 nothing was met, 1 nothing shines through
    weights: Float[Tensor, "*r s"]
    samples: RaySamples
    density: Float[Tensor, "*r s"] | None = None  # per metre, at the samples


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """Colour, depth and opacity of each pixel."""

    rgb: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]  # planar z, metres; 0 where less than half of the ray was stopped
    opacity: Float[Tensor, "h w"]


def query_samples(field: RadianceField, rays: Rays, samples: RaySamples) -> FieldValues:
    """Return the field's values at the samples (*r s). At samples that are not valid, density is 0.

    There the field is not queried or, where the host must not wait for the device (see ``waiting``), queried at the origin.
    """
    valid = samples.valid
    positions = rays.at(samples.middles)
    directions = rays.directions[..., None, :].expand_as(positions)
    if not may_wait(valid.device):
        found = field.query(torch.where(valid[..., None], positions, 0), directions)
        return FieldValues(torch.where(valid, found.density, 0), found.rgb)
    if bool(valid.all()):
        return field.query(positions, directions)
    index = valid.reshape(-1).nonzero()[:, 0]
    found = field.query(
        positions.reshape(-1, 3).index_select(0, index), directions.reshape(-1, 3).index_select(0, index)
    )
    density = found.density.new_zeros(valid.numel()).index_copy(0, index, found.density)
    rgb = found.rgb.new_zeros((valid.numel(), 3)).index_copy(0, index, found.rgb)
    return FieldValues(density.reshape(valid.shape), rgb.reshape(*valid.shape, 3))


def rendering_weights(density: Float[Tensor, "*r s"], samples: RaySamples) -> Float[Tensor, "*r s"]:
    """Return ``w_i = exp(-sum_{j<i} sigma_j dt_j) (1 - exp(-sigma_i dt_i))`` (eq. 3)."""
    absorbed = torch.where(
        samples.valid, density * (samples.ends - samples.starts), torch.zeros_like(density)
    )
    before = torch.cumsum(absorbed, dim=-1) - absorbed
    return torch.exp(-before) * -torch.expm1(-absorbed)


def render(
    field: RadianceField,
    rays: Rays,
    background: tuple[float, float, float] | Float[Tensor, "*#r 3"] = (0.0, 0.0, 0.0),
    jitter: Generator | None = None,
) -> Rendering:
    """Render rays; differentiable in the field's parameters and in the rays."""
    return render_samples(field, rays, field.sampler(rays, jitter), background)


def render_samples(
    field: RadianceField,
    rays: Rays,
    samples: RaySamples,
    background: tuple[float, float, float] | Float[Tensor, "*#r 3"] = (0.0, 0.0, 0.0),
) -> Rendering:
    """Render rays from given samples, see ``render``."""
    values = query_samples(field, rays, samples)
    weights = rendering_weights(values.density, samples)
    opacity = weights.sum(-1)
    behind = constant(background, weights) if isinstance(background, tuple) else background.to(weights)
    rgb = (weights[..., None] * values.rgb).sum(-2) + (1 - opacity)[..., None] * behind
    return Rendering(rgb, (weights * samples.middles).sum(-1), opacity, weights, samples, values.density)


@torch.no_grad()
def render_image(
    field: RadianceField, intrinsics: Intrinsics, T_world_camera: SE3, bounds: SceneBounds, chunk: int = 8192
) -> RenderedImage:
    """Render a whole image from a pose, ``chunk`` rays at a time."""
    ray = intrinsics.unproject(intrinsics.pixel_centres()).reshape(-1, 3)
    length = torch.linalg.vector_norm(ray, dim=-1)
    device = next((p.device for p in getattr(field, "parameters", lambda: iter(()))()), torch.device("cpu"))
    T = T_world_camera.to(dtype=torch.float32, device=device)
    parts = []
    for directions in (ray / length[:, None]).to(device).split(chunk):
        turned = T.rotate(directions)
        rendering = render(field, bounds.rays(T.translation.expand_as(turned), turned), bounds.background)
        parts.append(
            torch.cat([rendering.rgb, rendering.distance[:, None], rendering.opacity[:, None]], -1).cpu()
        )
    rgb, distance, opacity = torch.cat(parts).split([3, 1, 1], dim=-1)
    hit = torch.where(opacity > 0.5, distance / opacity.clamp(min=0.5), 0)[:, 0] / length
    shape = (intrinsics.height, intrinsics.width)
    return RenderedImage(rgb.clamp(0, 1).reshape(*shape, 3), hit.reshape(shape), opacity.reshape(shape))
