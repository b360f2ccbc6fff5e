"""Volume rendering (Mildenhall et al. 2020, eq. 3; BID-NeRF, eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor
from torch.nn.functional import interpolate, max_pool2d

from bidnerf_core.camera import Intrinsics, exposure_times, poses_of_rows
from bidnerf_core.devices import constant, may_wait
from bidnerf_core.fields.contract import (
    FieldValues,
    HitField,
    RadianceField,
    RayHits,
    Rays,
    RaySamples,
    SceneBounds,
    device_of,
)
from bidnerf_core.geometry import SE3
from bidnerf_core.progress import check_stopped

PICTURE_CONTRAST = 0.12
"""Difference of neighbours (of colours and opacity; of distances, as a share) beyond which pictures are rendered pixel by pixel."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """Colour, distance and opacity of each ray."""

    rgb: Float[Tensor, "*r 3"]
    distance: Float[Tensor, "*r"]  # sum of weight times distance, metres: not divided by the opacity
    opacity: Float[Tensor, "*r"]  # 0: nothing was hit, 1: fully opaque
    weights: Float[Tensor, "*r s"]
    samples: RaySamples
    density: Float[Tensor, "*r s"] | None = None  # per metre, at the samples


@dataclass(frozen=True, eq=False)
class RenderedImage:
    """Colour, depth and opacity of each pixel."""

    rgb: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]  # planar z, metres; 0 where the opacity is below one half
    opacity: Float[Tensor, "h w"]


def query_samples(field: RadianceField, rays: Rays, samples: RaySamples) -> FieldValues:
    """Return the field's values at the samples (*r s), with density 0 at invalid samples.

    Invalid samples are skipped. If the host must not wait for the device to count them (see ``may_wait``), the
    field is queried at the origin instead, and the result is discarded.
    """
    valid = samples.valid
    if not may_wait(valid.device) or bool(valid.all()):
        return _query_all(field, rays, samples)
    found = _query_valid(field, rays, samples)
    rgb = found.values.rgb.new_zeros((valid.numel(), 3)).index_copy(0, found.index, found.values.rgb)
    return FieldValues(_padded(found.values.density, found.index, valid), rgb.reshape(*valid.shape, 3))


@dataclass(frozen=True, eq=False)
class _ValidSamples:
    """The valid samples of all rays, ray by ray, and the field's values there."""

    index: Int[Tensor, "n"]  # index of each among all samples
    ray: Int[Tensor, "n"]  # index of each sample's ray
    values: FieldValues


def _query_all(field: RadianceField, rays: Rays, samples: RaySamples) -> FieldValues:
    """Return the values at all samples, either because all are valid or because the host must not wait to count them."""
    positions = rays.at(samples.middles)
    directions = rays.directions[..., None, :].expand_as(positions)
    if may_wait(samples.valid.device):
        return field.query(positions, directions)
    found = field.query(torch.where(samples.valid[..., None], positions, 0), directions)
    return FieldValues(torch.where(samples.valid, found.density, 0), found.rgb)


def _query_valid(field: RadianceField, rays: Rays, samples: RaySamples) -> _ValidSamples:
    count = samples.valid.shape[-1]
    ray, slot = samples.valid.reshape(-1, count).nonzero(as_tuple=True)
    index = ray * count + slot
    # Positions are computed only for these samples: often most of a row is padding.
    origins, directions = (
        part.reshape(-1, 3).index_select(0, ray) for part in (rays.origins, rays.directions)
    )
    middles = samples.middles.reshape(-1).index_select(0, index)
    return _ValidSamples(index, ray, field.query(origins + middles[:, None] * directions, directions))


def _padded(
    values: Float[Tensor, "n"], index: Int[Tensor, "n"], valid: Bool[Tensor, "*r s"]
) -> Float[Tensor, "*r s"]:
    """Return the values of the valid samples in place, and 0 elsewhere."""
    return values.new_zeros(valid.numel()).index_copy(0, index, values).reshape(valid.shape)


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
    if isinstance(field, HitField):
        return render_hits(field.hits(rays), background)
    return render_samples(field, rays, field.sampler(rays, jitter), background)


def render_samples(
    field: RadianceField,
    rays: Rays,
    samples: RaySamples,
    background: tuple[float, float, float] | Float[Tensor, "*#r 3"] = (0.0, 0.0, 0.0),
) -> Rendering:
    """Render rays from given samples, see ``render``."""
    weights, density, colour = _composed(field, rays, samples)
    return _over(background, colour, weights, samples, density)


def render_hits(
    hits: RayHits, background: tuple[float, float, float] | Float[Tensor, "*#r 3"] = (0.0, 0.0, 0.0)
) -> Rendering:
    """Composite the hits of rays: ``w_i = alpha_i prod_{j<i} (1 - alpha_j)``, which is eq. 3 with ``alpha = 1
    - exp(-sigma dt)``.
    """
    passed = torch.cumprod(1 - hits.alpha, dim=-1)
    before = torch.cat([torch.ones_like(passed[..., :1]), passed[..., :-1]], dim=-1)[..., : passed.shape[-1]]
    weights = hits.alpha * before
    colour = (weights[..., None] * hits.rgb).sum(-2)
    return _over(background, colour, weights, hits.samples, None)


def _over(
    background: tuple[float, float, float] | Float[Tensor, "*#r 3"], colour: Float[Tensor, "*r 3"],
    weights: Float[Tensor, "*r s"], samples: RaySamples, density: Float[Tensor, "*r s"] | None,
) -> Rendering:  # fmt: skip
    """Return the rendering of rays with these colours in front of ``background``."""
    opacity = weights.sum(-1)
    behind = constant(background, weights) if isinstance(background, tuple) else background.to(weights)
    rgb = colour + (1 - opacity)[..., None] * behind
    return Rendering(rgb, (weights * samples.middles).sum(-1), opacity, weights, samples, density)


def _composed(
    field: RadianceField, rays: Rays, samples: RaySamples
) -> tuple[Float[Tensor, "*r s"], Float[Tensor, "*r s"], Float[Tensor, "*r 3"]]:
    """Return the weights and densities of the samples, and the sum of weight times colour (eq. 3)."""
    valid = samples.valid
    # On other devices a sum over the samples of each ray has no fixed order, and would differ from run to run.
    if valid.device.type != "cpu" or bool(valid.all()):
        values = query_samples(field, rays, samples)
        weights = rendering_weights(values.density, samples)
        return weights, values.density, (weights[..., None] * values.rgb).sum(-2)
    found = _query_valid(field, rays, samples)
    density = _padded(found.values.density, found.index, valid)
    weights = rendering_weights(density, samples)
    share = weights.reshape(-1).index_select(0, found.index)[:, None] * found.values.rgb
    colour = share.new_zeros((rays.near.numel(), 3)).index_add(0, found.ray, share)
    return weights, density, colour.reshape(*valid.shape[:-1], 3)


@torch.no_grad()
def render_image(
    field: RadianceField, intrinsics: Intrinsics, T_world_camera: SE3, bounds: SceneBounds, chunk: int = 8192,
    motion: Float[Tensor, "6"] | None = None,
) -> RenderedImage:  # fmt: skip
    """Render a whole image from a pose, ``chunk`` rays at a time.

    ``motion`` is the camera's motion from the first row to the last, see ``rolling_shutter``; without it, the
    camera is static.
    """
    pixels = intrinsics.pixel_centres().reshape(-1, 2)
    return _image_of(_rendered(field, intrinsics, T_world_camera, bounds, pixels, chunk, motion), intrinsics)


@torch.no_grad()
def render_picture(
    field: RadianceField, intrinsics: Intrinsics, T_world_camera: SE3, bounds: SceneBounds, chunk: int = 8192
) -> RenderedImage:  # fmt: skip
    """Render an image to look at: every second pixel of every second row, and of the others those whose neighbours differ.

    The others are interpolated, which misses only what is smaller than two pixels, and saves up to half of the time, see ``PICTURE_CONTRAST``.
    """
    pixels = intrinsics.pixel_centres().reshape(-1, 2)
    height, width = intrinsics.height, intrinsics.width
    first = torch.zeros((height, width), dtype=torch.bool)
    first[::2, ::2] = True
    values = torch.zeros((height, width, 5))
    values[first] = _rendered(field, intrinsics, T_world_camera, bounds, pixels[first.reshape(-1)], chunk)
    coarse = values[::2, ::2].movedim(-1, 0)[None]
    size = 2 * coarse.shape[2] - 1, 2 * coarse.shape[3] - 1  # of what lies between the first pixels
    between = interpolate(coarse, size=size, mode="bilinear", align_corners=True)[0].movedim(0, -1)
    again = ~first
    again[: size[0], : size[1]] &= _differs(coarse)[: size[0], : size[1]]
    filled = ~first & ~again
    values[filled] = between[:height, :width][filled[: size[0], : size[1]]]
    values[again] = _rendered(field, intrinsics, T_world_camera, bounds, pixels[again.reshape(-1)], chunk)
    return _image_of(values.reshape(-1, 5), intrinsics)


def _differs(coarse: Float[Tensor, "1 5 h w"]) -> Bool[Tensor, "H W"]:
    """Return where the first pixels around a pixel of the whole image differ too much to interpolate between them."""
    largest, least = max_pool2d(coarse, 3, 1, 1)[0], -max_pool2d(-coarse, 3, 1, 1)[0]
    distance, shown = largest[3], torch.cat([largest[:3] - least[:3], largest[4:] - least[4:]])
    apart = (shown > PICTURE_CONTRAST).any(0) | (distance - least[3] > PICTURE_CONTRAST * distance)
    return apart.repeat_interleave(2, 0).repeat_interleave(2, 1)


def _rendered(
    field: RadianceField, intrinsics: Intrinsics, T_world_camera: SE3, bounds: SceneBounds, pixels: Float[Tensor, "n 2"],
    chunk: int, motion: Float[Tensor, "6"] | None = None,
) -> Float[Tensor, "n 5"]:  # fmt: skip
    """Return colour, planar depth where the opacity is at least one half, and opacity of some pixels."""
    ray, length = intrinsics.rays(pixels)
    device = device_of(field)
    T = T_world_camera.to(dtype=torch.float32, device=device)
    motion = motion if motion is not None and bool(motion.any()) else None
    times = exposure_times(pixels, intrinsics).to(T.translation).split(chunk)
    parts = []
    for directions, when in zip(ray.to(device).split(chunk), times, strict=True):
        check_stopped()
        at = T if motion is None else T @ poses_of_rows(when, motion)
        turned = at.rotate(directions)
        rendering = render(field, bounds.rays(at.translation.expand_as(turned), turned), bounds.background)
        parts.append(
            torch.cat([rendering.rgb, rendering.distance[:, None], rendering.opacity[:, None]], -1).cpu()
        )
    rgb, distance, opacity = torch.cat(parts).split([3, 1, 1], dim=-1)
    hit = torch.where(opacity > 0.5, distance / opacity.clamp(min=0.5), 0) / length[:, None]
    return torch.cat([rgb.clamp(0, 1), hit, opacity], -1)


def _image_of(values: Float[Tensor, "n 5"], intrinsics: Intrinsics) -> RenderedImage:
    rgb, depth, opacity = values.reshape(intrinsics.height, intrinsics.width, 5).split([3, 1, 1], dim=-1)
    return RenderedImage(rgb, depth[..., 0], opacity[..., 0])
