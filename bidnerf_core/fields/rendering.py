"""Rays with measurements, and volume rendering (Mildenhall et al. 2020, eq. 3; BID-NeRF, eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import interpolate, max_pool2d, pad

from bidnerf_core.camera import Intrinsics, exposure_times, poses_of_rows
from bidnerf_core.devices import TensorRows, constant, may_wait
from bidnerf_core.errors import InputError
from bidnerf_core.fields.contract import (
    DifferentiatedField,
    FieldValues,
    HitField,
    RadianceField,
    Rays,
    RaySamples,
    SceneBounds,
    device_of,
    is_frozen,
)
from bidnerf_core.geometry import SE3
from bidnerf_core.progress import check_cancelled


@dataclass(frozen=True, eq=False)
class Observations(TensorRows):
    """Half-lines in a reference frame with the colours and distances that sensors measured along them.

    Examples are the pixels of an RGB-D image, the returns of a lidar and the points of structure from motion.
    """

    origins: Float[Tensor, "*p 3"]  # metres, reference frame
    directions: Float[Tensor, "*p 3"]  # unit, reference frame
    rgb: Float[Tensor, "*p 3"]  # in [0, 1]; 0 where not coloured
    distance: Float[Tensor, "*p"]  # metres along the ray, not z; 0 where nothing was measured
    coloured: Bool[Tensor, "*p"]  # whether a colour was measured

    @staticmethod
    def from_points(points: Float[Tensor, "n 3"], T_ref_sensor: SE3) -> Observations:
        """Return rays to ``points`` (metres), as measured by a sensor at the origin of their frame; float64.

        Points that are not finite or lie at the origin (missing returns of a lidar) are left out. Raises
        ``InputError`` if no point remains.
        """
        points = points.to(torch.float64)
        distance = torch.linalg.vector_norm(points, dim=-1)
        measured = distance.isfinite() & (distance > 0)
        T = T_ref_sensor.to(points)
        directions = T.rotate(points[measured] / distance[measured][:, None])
        return Observations.of_depth(T.translation.expand_as(directions), directions, distance[measured])

    @staticmethod
    def of_depth(
        origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"], distance: Float[Tensor, "n"]
    ) -> Observations:
        """Return rays with a measured distance (metres, > 0) but no colour. Raises ``InputError`` if there are no rays."""
        if len(distance) == 0:
            raise InputError("nothing was measured", where="depth rays", expected="at least one finite point in front")
        coloured = torch.zeros(len(distance), dtype=torch.bool, device=distance.device)
        return Observations(origins, directions, torch.zeros_like(directions), distance, coloured)

    @property
    def measured(self) -> Bool[Tensor, "*p"]:
        """The mask of the rays along which a distance was measured."""
        return self.distance > 0

    @property
    def points(self) -> Float[Tensor, "*p 3"]:
        """The measured points (metres, reference frame); the ray's origin where no distance was measured."""
        return self.origins + self.distance[..., None] * self.directions

    def flattened(self) -> Observations:
        """Return these rays flattened to one axis."""
        return self.map(lambda part: part.reshape(-1, *part.shape[self.distance.ndim :]))

    def drawn(
        self,
        count: int,
        generator: Generator,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str | None = None,
    ) -> Observations:
        """Draw ``count`` rays uniformly with replacement, or return all rays if there are at most ``count``."""
        if count >= len(self):
            return self.to(device, dtype)
        index = torch.randint(len(self), (count,), generator=generator, device=generator.device)
        return self[index.to(self.distance.device)].to(device, dtype)

    def to(self, device: torch.device | str | None, dtype: torch.dtype) -> Observations:
        """Return these rays on another device and in another floating-point type."""
        return self.map(lambda part: part.to(device, dtype if part.is_floating_point() else part.dtype))

    def rays(self, T_world_ref: SE3, bounds: SceneBounds) -> Rays:
        """Return the rays in the world, clipped to the scene's bounds; differentiable with respect to the transform.

        A batch of transforms (h) gives rays of shape (h *p).
        """
        T = T_world_ref.to(self.origins)
        if T.translation.ndim > 1:
            ones = (1,) * self.distance.ndim
            batch = T.translation.shape[:-1]
            T = SE3(T.rotation.reshape(*batch, *ones, 3, 3), T.translation.reshape(*batch, *ones, 3))
        return bounds.rays(T.apply(self.origins), T.rotate(self.directions))


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

    Invalid samples are skipped. If the host must not wait for the device to count them (see ``may_wait``), the field
    is queried at the origin instead, and the result is discarded. In that case, if gradients are needed for the rays
    but not for the field's parameters, a ``DifferentiatedField`` provides the derivatives.
    """
    valid = samples.valid
    waiting = may_wait(valid.device)
    if not waiting or bool(valid.all()):
        positions = torch.where(valid[..., None], rays.at(samples.middles), 0)
        directions = rays.directions[..., None, :].expand_as(positions)
        moving = torch.is_grad_enabled() and (rays.origins.requires_grad or rays.directions.requires_grad)
        if moving and not waiting and isinstance(field, DifferentiatedField) and is_frozen(field):
            output = _Queried.apply(positions.reshape(-1, 3), directions.reshape(-1, 3), valid.reshape(-1), field)
            density, rgb = output.view(*valid.shape, 4).split((1, 3), -1)
            return FieldValues(density[..., 0], rgb)
        output = field.query(positions, directions)
        return FieldValues(torch.where(valid, output.density, 0), output.rgb)
    index = valid.reshape(-1).nonzero()[:, 0]
    output = field.query(*points_of(rays, samples, index))
    density = output.density.new_zeros(valid.numel()).index_copy(0, index, output.density)
    rgb = output.rgb.new_zeros((valid.numel(), 3)).index_copy(0, index, output.rgb)
    return FieldValues(density.reshape(valid.shape), rgb.reshape(*valid.shape, 3))


def points_of(
    rays: Rays, samples: RaySamples, index: Int[Tensor, "n"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return the positions (metres, world) of the samples with these flat indices, and the directions of their rays."""
    ray = index // samples.valid.shape[-1]
    origins, directions = (part.reshape(-1, 3).index_select(0, ray) for part in (rays.origins, rays.directions))
    return origins + samples.middles.reshape(-1).index_select(0, index)[:, None] * directions, directions


class _Queried(torch.autograd.Function):
    """Density and colour (p 4) at points, 0 at unwanted points, differentiated by the field's own derivatives."""

    @staticmethod
    def forward(
        ctx: Any,
        positions: Float[Tensor, "p 3"],
        directions: Float[Tensor, "p 3"],
        wanted: Bool[Tensor, "p"],
        field: DifferentiatedField,
    ) -> Float[Tensor, "p 4"]:
        derivatives = field.jacobian(positions, directions, wanted)
        ctx.save_for_backward(derivatives.by_position, derivatives.by_direction, wanted)
        values = torch.cat([derivatives.values.density[:, None], derivatives.values.rgb], -1)
        return torch.where(wanted[:, None], values, constant((0.0,), values))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "p 4"]) -> tuple[Tensor | None, ...]:
        *by_both, wanted = ctx.saved_tensors
        pull = torch.where(wanted[:, None], gradient, constant((0.0,), gradient))[..., None]
        return *((pull * by).sum(1) for by in by_both), None, None


def rendering_weights(density: Float[Tensor, "*r s"], samples: RaySamples) -> Float[Tensor, "*r s"]:
    """Return ``w_i = exp(-sum_{j<i} sigma_j dt_j) (1 - exp(-sigma_i dt_i))`` (eq. 3)."""
    absorbed = torch.where(samples.valid, density * (samples.ends - samples.starts), constant((0.0,), density))
    before = torch.cumsum(absorbed, dim=-1) - absorbed
    return torch.exp(-before) * -torch.expm1(-absorbed)


def render(
    field: RadianceField,
    rays: Rays,
    background: tuple[float, float, float] | Float[Tensor, "*#r 3"] = (0.0, 0.0, 0.0),
    jitter: Generator | None = None,
) -> Rendering:
    """Render rays in front of a background colour (RGB in [0, 1]), one for all rays or one per ray.

    The result is differentiable in the field's parameters and in the rays. ``jitter`` randomizes the samples. Hits are
    composited as ``w_i = alpha_i prod_{j<i} (1 - alpha_j)``, which is eq. 3 with ``alpha = 1 - exp(-sigma dt)``.
    """
    if isinstance(field, HitField):
        hits = field.hits(rays)
        weights = hits.alpha * pad(torch.cumprod(1 - hits.alpha, dim=-1), (1, 0), value=1.0)[..., :-1]
        return _over(background, hits.rgb, weights, hits.samples, None)
    return render_samples(field, rays, field.sampler(rays, jitter), background)


def render_samples(
    field: RadianceField,
    rays: Rays,
    samples: RaySamples,
    background: tuple[float, float, float] | Float[Tensor, "*#r 3"] = (0.0, 0.0, 0.0),
) -> Rendering:
    """Render rays from given samples, see ``render``."""
    return render_values(query_samples(field, rays, samples), samples, background)


def render_values(
    values: FieldValues,
    samples: RaySamples,
    background: tuple[float, float, float] | Float[Tensor, "*#r 3"] = (0.0, 0.0, 0.0),
) -> Rendering:
    """Render rays from a field's values at their samples (*r s), see ``render``."""
    if torch.is_grad_enabled() and not (samples.starts.requires_grad or samples.ends.requires_grad):
        rgb, distance, opacity, weights = _Composite.apply(values.density, values.rgb, *samples.parts)
        behind = constant(background, rgb) if isinstance(background, tuple) else background.to(rgb)
        rgb = rgb + (1 - opacity)[..., None] * behind
        return Rendering(rgb, distance, opacity, weights, samples, values.density)
    weights = rendering_weights(values.density, samples)
    return _over(background, values.rgb, weights, samples, values.density)


class _Composite(torch.autograd.Function):
    """Colour (without background), distance, opacity and weights of rays, from density and colour at their samples.

    If ``q_i`` is the derivative of the loss with respect to weight i, the derivative of the loss with respect to
    the density of sample i, of length l_i, is ``l_i (T_i+1 q_i - sum_j>i w_j q_j)``, where T_i+1 is the
    transmittance behind the sample.
    """

    @staticmethod
    def forward(
        ctx: Any,
        density: Float[Tensor, "*r s"],
        rgb: Float[Tensor, "*r s 3"],
        starts: Float[Tensor, "*r s"],
        ends: Float[Tensor, "*r s"],
        valid: Bool[Tensor, "*r s"],
    ) -> tuple[Tensor, ...]:
        samples = RaySamples(starts, ends, valid)
        weights = rendering_weights(density, samples)
        ctx.save_for_backward(density, rgb, weights, *samples.parts)
        middles = samples.middles
        return (weights[..., None] * rgb).sum(-2), (weights * middles).sum(-1), weights.sum(-1), weights

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, to_rgb: Tensor, to_distance: Tensor, to_opacity: Tensor, to_weights: Tensor
    ) -> tuple[Tensor | None, ...]:
        density, rgb, weights, starts, ends, valid = ctx.saved_tensors
        length, to_rgb = ends - starts, to_rgb[..., None, :]
        by_weight = (to_rgb * rgb).sum(-1) + to_distance[..., None] * (starts + ends) / 2 + to_opacity[..., None]
        by_weight = by_weight + to_weights
        share = weights * by_weight
        behind = share.sum(-1, keepdim=True) - share.cumsum(-1)
        nothing = constant((0.0,), density)
        passed = torch.exp(-torch.where(valid, density * length, nothing).cumsum(-1))
        to_density = torch.where(valid, length * (passed * by_weight - behind), nothing)
        return to_density, weights[..., None] * to_rgb, None, None, None


def _over(
    background: tuple[float, float, float] | Float[Tensor, "*#r 3"],
    colours: Float[Tensor, "*r s 3"],
    weights: Float[Tensor, "*r s"],
    samples: RaySamples,
    density: Float[Tensor, "*r s"] | None,
) -> Rendering:
    """Return the rendering of weighted samples with these colours in front of ``background``."""
    opacity = weights.sum(-1)
    behind = constant(background, weights) if isinstance(background, tuple) else background.to(weights)
    rgb = (weights[..., None] * colours).sum(-2) + (1 - opacity)[..., None] * behind
    return Rendering(rgb, (weights * samples.middles).sum(-1), opacity, weights, samples, density)


@torch.no_grad()
def render_image(
    field: RadianceField,
    intrinsics: Intrinsics,
    T_world_camera: SE3,
    bounds: SceneBounds,
    chunk: int = 8192,
    motion: Float[Tensor, "6"] | None = None,
) -> RenderedImage:
    """Render a whole image from a pose (``T_world_camera``), ``chunk`` rays at a time.

    ``motion`` is the camera's motion from the first row to the last (translation in metres, then rotation in
    radians), see ``rolling_shutter``; without it, the camera is static.
    """
    pixels = intrinsics.pixel_centres().reshape(-1, 2)
    return _image_of(_render_pixels(field, intrinsics, T_world_camera, bounds, pixels, chunk, motion), intrinsics)


@torch.no_grad()
def render_picture(
    field: RadianceField, intrinsics: Intrinsics, T_world_camera: SE3, bounds: SceneBounds, chunk: int = 8192
) -> RenderedImage:
    """Render an image for display: every second pixel of every second row, and those in between whose neighbours differ.

    All other pixels are interpolated. This misses only details smaller than two pixels, and saves up to half of the time.
    """
    pixels = intrinsics.pixel_centres().reshape(-1, 2)
    height, width = intrinsics.height, intrinsics.width
    first = torch.zeros((height, width), dtype=torch.bool)
    first[::2, ::2] = True
    values = torch.zeros((height, width, 5))
    values[first] = _render_pixels(field, intrinsics, T_world_camera, bounds, pixels[first.reshape(-1)], chunk)
    coarse = values[::2, ::2].movedim(-1, 0)[None]
    size = 2 * coarse.shape[2] - 1, 2 * coarse.shape[3] - 1  # of what lies between the first pixels
    between = interpolate(coarse, size=size, mode="bilinear", align_corners=True)[0].movedim(0, -1)
    largest, least = max_pool2d(coarse, 3, 1, 1)[0], -max_pool2d(-coarse, 3, 1, 1)[0]
    distance, shown = largest[3], torch.cat([largest[:3] - least[:3], largest[4:] - least[4:]])
    # Neighbours differ if a colour or the opacity does by more than 0.12, or the distance by more than 12 %.
    differs = (shown > 0.12).any(0) | (distance - least[3] > 0.12 * distance)
    differs = differs.repeat_interleave(2, 0).repeat_interleave(2, 1)
    again = ~first
    again[: size[0], : size[1]] &= differs[: size[0], : size[1]]
    filled = ~first & ~again
    values[filled] = between[:height, :width][filled[: size[0], : size[1]]]
    values[again] = _render_pixels(field, intrinsics, T_world_camera, bounds, pixels[again.reshape(-1)], chunk)
    return _image_of(values.reshape(-1, 5), intrinsics)


def _render_pixels(
    field: RadianceField,
    intrinsics: Intrinsics,
    T_world_camera: SE3,
    bounds: SceneBounds,
    pixels: Float[Tensor, "n 2"],
    chunk: int,
    motion: Float[Tensor, "6"] | None = None,
) -> Float[Tensor, "n 5"]:
    """Return the colour, planar depth (metres; 0 unless the opacity exceeds one half) and opacity of the given pixels."""
    ray, length = intrinsics.rays(pixels)
    device = device_of(field)
    T = T_world_camera.to(dtype=torch.float32, device=device)
    motion = motion if motion is not None and bool(motion.any()) else None
    times = exposure_times(pixels, intrinsics).to(T.translation).split(chunk)
    parts = []
    for directions, when in zip(ray.to(device).split(chunk), times, strict=True):
        check_cancelled("rendering")
        at = T if motion is None else T @ poses_of_rows(when, motion)
        turned = at.rotate(directions)
        rendering = render(field, bounds.rays(at.translation.expand_as(turned), turned), bounds.background)
        parts.append(torch.cat([rendering.rgb, rendering.distance[:, None], rendering.opacity[:, None]], -1).cpu())
    rgb, distance, opacity = torch.cat(parts).split([3, 1, 1], dim=-1)
    hit = torch.where(opacity > 0.5, distance / opacity.clamp(min=0.5), 0) / length[:, None]
    return torch.cat([rgb.clamp(0, 1), hit, opacity], -1)


def _image_of(values: Float[Tensor, "n 5"], intrinsics: Intrinsics) -> RenderedImage:
    rgb, depth, opacity = values.reshape(intrinsics.height, intrinsics.width, 5).split([3, 1, 1], dim=-1)
    return RenderedImage(rgb, depth[..., 0], opacity[..., 0])
