"""The cost of whole small images: photos are compared with renderings of a map from many poses.

Thumbnails are small, smoothed photos. Renderers quickly render the same views, without derivatives, from the baked surface or a
field. The derivative of a rendered image with respect to the pose follows from the image's gradient and its depth for any renderer; automatic
differentiation is not needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, interpolate, pad

from bidnerf_core.camera import Intrinsics
from bidnerf_core.devices import constant
from bidnerf_core.fields import RadianceField, SceneBounds, render
from bidnerf_core.frames import View, continued
from bidnerf_core.geometry import SE3, inlier_weight
from bidnerf_core.localization.exposure import Exposure, clipped, fit_exposure
from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.mapping import SurfaceMap, cast

KERNEL_REACH = 3.0
"""Radius of a blurring kernel in standard deviations."""
CHUNK = 16384
"""Number of rays rendered at a time."""
UNKNOWN_COST = 0.7
"""Cost of a pixel for which the map renders nothing."""


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A view resampled to a small camera without distortion. Derived tensors are on the device of ``rgb``."""

    camera: Intrinsics
    T_last_camera: SE3
    rgb: Float[Tensor, "3 h w"]  # smoothed

    @cached_property
    def flat(self) -> Float[Tensor, "n 3"]:
        """The pixels' points on the plane z = 1 of the camera frame, row by row."""
        return self.camera.unproject(self.camera.pixel_centres()).reshape(-1, 3).to(self.rgb.device)

    @cached_property
    def directions(self) -> Float[Tensor, "n 3"]:
        """The pixels' unit directions, in the last camera's frame."""
        return self.T_last_camera.to(self.flat).rotate(torch.nn.functional.normalize(self.flat, dim=-1))

    @cached_property
    def directness(self) -> Float[Tensor, "n"]:
        """Ratio of depth (planar z) to distance along each ray."""
        return 1 / torch.linalg.vector_norm(self.flat, dim=-1)

    @cached_property
    def origin(self) -> Float[Tensor, "3"]:
        return self.T_last_camera.translation.to(self.flat)

    @cached_property
    def rotation(self) -> Float[Tensor, "3 3"]:
        """Rotation from the camera's frame to the last camera's."""
        return self.T_last_camera.rotation.to(self.flat)

    @cached_property
    def slopes(self) -> Float[Tensor, "3 n 2"]:
        return slopes(self.rgb, self.camera)


def thumbnail(view: View, width: int) -> Thumbnail:
    """Return ``view`` undistorted, smoothed and reduced to at most ``width`` pixels on its longer side; on the CPU."""
    camera = view.frame.intrinsics
    small = replace(camera.scaled(min(1.0, width / max(camera.width, camera.height))), distortion=())
    rgb = continued(view.frame).cpu().float().permute(2, 0, 1)[None]
    # Averaged first, so that every pixel of the image contributes.
    rgb = interpolate(rgb, (small.height, small.width), mode="area")
    if camera.distortion:
        seen = camera.project(small.unproject(small.pixel_centres())) / torch.tensor(
            [camera.width, camera.height]
        )
        rgb = grid_sample(rgb, 2 * seen[None] - 1, padding_mode="border", align_corners=False)
    return Thumbnail(small, view.T_ref_camera.to("cpu", torch.float64), smooth(rgb[0]))


def smooth(image: Float[Tensor, "*b h w"]) -> Float[Tensor, "*b h w"]:
    """Convolve with a 5x5 binomial kernel, approximately a Gaussian of one pixel; the border is replicated."""
    kernel = constant((1.0, 4.0, 6.0, 4.0, 1.0), image) / 16
    flat = image.reshape(-1, 1, *image.shape[-2:])
    flat = conv2d(pad(flat, (2, 2, 0, 0), mode="replicate"), kernel.view(1, 1, 1, 5))
    flat = conv2d(pad(flat, (0, 0, 2, 2), mode="replicate"), kernel.view(1, 1, 5, 1))
    return flat.view(image.shape)


def gaussian_blurred(image: Float[Tensor, "b c h w"], pixels: float) -> Float[Tensor, "b c h w"]:
    """Convolve with a Gaussian of standard deviation ``pixels``; the border is replicated."""
    size = 2 * math.ceil(KERNEL_REACH * pixels) + 1
    return gaussian_blur2d(image, (size, size), (pixels, pixels), "replicate")


def slopes(image: Float[Tensor, "*b h w"], camera: Intrinsics) -> Float[Tensor, "*b n 2"]:
    """Return central differences to the right and down, per unit on the plane z = 1."""
    flat = image.reshape(-1, 1, *image.shape[-2:])
    wide = pad(flat, (1, 1, 1, 1), mode="replicate")
    across = (wide[..., 1:-1, 2:] - wide[..., 1:-1, :-2]) * (camera.fx / 2)
    down = (wide[..., 2:, 1:-1] - wide[..., :-2, 1:-1]) * (camera.fy / 2)
    return torch.stack([across, down], -1).reshape(*image.shape[:-2], -1, 2)


@dataclass(frozen=True, eq=False)
class RayColours:
    """The rendered colour and distance of rays."""

    rgb: Float[Tensor, "r 3"]  # premultiplied by ``known``
    known: Float[Tensor, "r"]  # 0 where the map has nothing along the ray
    # Metres to the visible point or, for the background, to where the ray passes closest to the scene.
    along: Float[Tensor, "r"]


@runtime_checkable
class ViewRenderer(Protocol):
    """Renders rays with unit directions (world frame)."""

    @property
    def device(self) -> torch.device:
        """Device of the rays and the returned colours."""
        ...

    def __call__(self, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"]) -> RayColours: ...


@dataclass(frozen=True, eq=False)
class SurfaceRenderer:
    """Renders the colours of surfels and, if the scene has a background, its colour behind them."""

    surface: SurfaceMap
    background: (
        tuple[float, float, float] | None
    )  # None: a ray that hits nothing passes through a hole in the map

    @property
    def device(self) -> torch.device:
        return self.surface.device

    def __call__(self, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"]) -> RayColours:
        found = cast(self.surface, origins, directions)
        met = found.met[:, None].to(origins)
        behind = constant(self.background or (0.0, 0.0, 0.0), origins)
        rgb = met * self.surface.surfels.rgb[found.index] + (1 - met) * behind
        known = met[:, 0] if self.background is None else torch.ones_like(found.along)
        return RayColours(rgb, known, found.along.clamp(min=self.surface.cell))


@dataclass(frozen=True, eq=False)
class FieldRenderer:
    """Renders a field with its background."""

    field: RadianceField
    bounds: SceneBounds
    device: torch.device

    @torch.no_grad()
    def __call__(self, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"]) -> RayColours:
        lower, upper = (constant(corner, origins) for corner in (self.bounds.lower, self.bounds.upper))
        middle = (lower + upper) / 2
        passing = ((middle - origins) * directions).sum(-1)
        parts = [
            self._rendered(*some) for some in zip(origins.split(CHUNK), directions.split(CHUNK), strict=True)
        ]
        rgb, along, opacity = (torch.cat(values) for values in zip(*parts, strict=True))
        along = torch.where(opacity > 0.5, along / opacity.clamp(min=0.5), passing)
        return RayColours(rgb, torch.ones_like(along), along.clamp(min=self.bounds.near))

    def _rendered(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen = render(self.field, self.bounds.rays(origins, directions), self.bounds.background)
        return seen.rgb, seen.distance, seen.opacity


@dataclass(frozen=True)
class ColourScales:
    """Scales for comparing colours and for fitting an image's exposure relative to the map."""

    colour: float = (
        0.2  # norm of a pixel's colour difference (three channels) at which its inlier weight is 1/2
    )
    gain: float = 0.2  # standard deviation of the prior about 1
    bias: float = 0.1  # standard deviation of the prior about 0
    exposure_rounds: int = 2  # number of rounds of robust reweighting, starting at a gain of 1; at least 1


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A thumbnail's n pixels as rendered from each of h poses."""

    camera: Intrinsics
    rgb: Float[Tensor, "h 3 n"]  # smoothed
    known: Float[Tensor, "h n"]  # fraction of the pixel that the map renders, 0 to 1
    points: Float[Tensor, "h n 3"]  # points visible in the pixels: metres, last camera's frame
    depth: Float[Tensor, "h n"]  # metres, in the thumbnail's camera

    @cached_property
    def slopes(self) -> Float[Tensor, "h 3 n 2"]:
        """Derivative of the colours with respect to position on the plane z = 1."""
        return slopes(self._image(self.rgb), self.camera)

    def blurred(self, pixels: float) -> RenderedView:
        """Return the view with its colours convolved with a Gaussian of standard deviation ``pixels``."""
        if pixels == 0:
            return self
        known = self.known[:, None]
        rgb, weight = (
            gaussian_blurred(self._image(part), pixels).flatten(2) for part in (self.rgb * known, known)
        )
        return replace(self, rgb=rgb / weight.clamp(min=1e-3), known=weight[:, 0])

    def _image(self, flat: Float[Tensor, "h c n"]) -> Float[Tensor, "h c y x"]:
        return flat.unflatten(-1, (self.camera.height, self.camera.width))


def render_view(renderer: ViewRenderer, small: Thumbnail, T: SE3) -> RenderedView:
    """Render a thumbnail's pixels from the poses T_world_last (h)."""
    camera, count, local = small.camera, len(T.translation), small.directions
    rotation, translation = T.rotation.to(local), T.translation.to(local)
    directions = local @ rotation.mT
    origins = (rotation @ small.origin + translation)[:, None].expand_as(directions)
    seen = renderer(origins.reshape(-1, 3), directions.reshape(-1, 3))
    rgb, known = (
        smooth(part.reshape(count, camera.height, camera.width, -1).permute(0, 3, 1, 2))
        for part in (seen.rgb, seen.known)
    )
    rgb = rgb / known.clamp(min=1e-3)
    along = seen.along.view(count, -1)
    points = small.origin + along[..., None] * local
    return RenderedView(camera, rgb.flatten(2), known.flatten(1), points, along * small.directness)


@dataclass(frozen=True, eq=False)
class ImageCost:
    """Mean over pixels of ``1 - 1 / (1 + c^2 / s^2)``, with the difference c between rendered and measured colour.

    Its normal equations are those of iteratively reweighted least squares. By the mean of both images' gradients, colours are
    linearized with second-order accuracy (Benhimane and Malis 2004, "Real-time image-based tracking of planes using efficient
    second-order minimization"). Updates rotate about ``pivot``. The cost is infinite for non-finite poses.
    """

    renderer: ViewRenderer
    thumbnails: Sequence[Thumbnail]
    scales: ColourScales
    pivot: Float[Tensor, "3"]  # metres, last camera's frame
    # Standard deviation of the photos' additional blur relative to renderings, pixels of thumbnails.
    blur: float = 0.0

    def __call__(self, T: SE3) -> NormalEquations:
        parts = [self._of_thumbnail(small, T) for small in self.thumbnails]
        cost, gradient, hessian = (
            torch.stack(values).mean(0).double() for values in zip(*parts, strict=True)
        )
        sound = T.translation.isfinite().all(-1) & T.rotation.isfinite().all(-1).all(-1)
        return NormalEquations(torch.where(sound, cost, torch.inf), gradient, hessian)

    def pixel_costs(self, T: SE3) -> Float[Tensor, "h n"]:
        """Return the cost of each pixel of all images."""
        seen = (render_view(self.renderer, small, T).blurred(self.blur) for small in self.thumbnails)
        compared = [self._compared(small, view) for small, view in zip(self.thumbnails, seen, strict=True)]
        return torch.cat([part.pixels for part in compared], -1).double()

    def with_blur_of(self, T: SE3, candidates: Sequence[float]) -> ImageCost:
        """Return the cost with the candidate blur for which renderings from one pose are most similar to the photos."""
        return replace(self, blur=candidates[int(self.costs_of_blurs(T, candidates).argmin())])

    def costs_of_blurs(self, T: SE3, candidates: Sequence[float]) -> Float[Tensor, "b"]:
        """Return the cost of one pose, rendered once, with each blur."""
        costs = torch.zeros(len(candidates), dtype=torch.float64, device=self.renderer.device)
        for small in self.thumbnails:
            seen = render_view(self.renderer, small, T[None])
            costs += torch.stack(
                [self._compared(small, seen.blurred(b)).cost[0] for b in candidates]
            ).double()
        return costs / len(self.thumbnails)

    def _of_thumbnail(self, small: Thumbnail, T: SE3) -> tuple[Tensor, Tensor, Tensor]:
        """Return the cost, its gradient and its Hessian of one image."""
        seen = render_view(self.renderer, small, T).blurred(self.blur)
        compared = self._compared(small, seen)
        by_point = _by_point(small, (seen.slopes + small.slopes) / 2, seen.depth)
        arm = (seen.points - self.pivot)[:, None].expand_as(by_point)
        rows = torch.cat([by_point, torch.linalg.cross(arm, by_point)], -1)
        weighted = (compared.weight[..., None] * rows).flatten(1, 2)
        gradient = (weighted.mT @ compared.error.flatten(1)[..., None])[..., 0]
        return compared.cost, gradient, weighted.mT @ rows.flatten(1, 2)

    def _compared(self, small: Thumbnail, seen: RenderedView) -> _Compared:
        """Compare a rendered image, at the best-fitting exposure, with the measured one."""
        measured, scale = small.rgb.flatten(1), self.scales.colour
        corrected = exposed(seen, measured, self.scales)
        error = corrected.clamp(0, 1) - measured
        near = inlier_weight((error**2).sum(1), scale)
        pixels = seen.known * (1 - near) + (1 - seen.known) * UNKNOWN_COST
        weight = seen.known * near**2 / scale**2 / error.shape[-1]
        inside = (
            corrected - 0.5
        ).abs() < 0.5  # where the camera clips, the colour does not depend on the pose
        return _Compared(pixels, error, weight[:, None] * inside)


@dataclass(frozen=True, eq=False)
class _Compared:
    """A rendered image compared with a measured one."""

    pixels: Float[Tensor, "h n"]  # cost of each pixel
    error: Float[Tensor, "h 3 n"]
    weight: Float[Tensor, "h 3 n"]  # of each squared error in a step

    @property
    def cost(self) -> Float[Tensor, "h"]:
        return self.pixels.mean(-1)


def plain_pixel_costs(thumbnails: Sequence[Thumbnail], scale: float) -> Float[Tensor, "n"]:
    """Return each pixel's cost for images with the median measured colour: the baseline that a pose must beat."""
    costs = []
    for small in thumbnails:
        measured = small.rgb.flatten(1)
        squared = ((measured - measured.median(-1, keepdim=True).values) ** 2).sum(0)
        costs.append(1 - inlier_weight(squared, scale))
    return torch.cat(costs)


def exposed(
    seen: RenderedView, measured: Float[Tensor, "3 n"], scales: ColourScales
) -> Float[Tensor, "h 3 n"]:
    """Return the rendered colours at the exposure that, given its priors, best fits the measured ones.

    The result is not clipped. Measured colours clipped at black or white do not influence the exposure.
    """
    if not (scales.gain and scales.bias):
        return seen.rgb
    exposure: Exposure | None = None
    for _ in range(scales.exposure_rounds):
        rgb = seen.rgb if exposure is None else exposure.applied(seen.rgb)
        near = inlier_weight(((measured - rgb) ** 2).sum(1, keepdim=True), scales.colour)
        weights = (seen.known[:, None] * near**2 / scales.colour**2) * ~clipped(rgb, measured)
        exposure = fit_exposure(seen.rgb, measured[None], weights, scales.gain**-2, scales.bias**-2)
    assert exposure is not None  # there is at least one round
    return exposure.applied(seen.rgb)


def _by_point(
    small: Thumbnail, slope: Float[Tensor, "h 3 n 2"], depth: Float[Tensor, "h n"]
) -> Float[Tensor, "h 3 n 3"]:
    """Return the derivative of each pixel's colour with respect to the camera's position, in the last camera's axes, per metre.

    A point (X, Y, Z) is seen at x = X / Z, y = Y / Z, and moves there by (dX - x dZ, dY - y dZ) / Z.
    """
    by_z = -(slope * small.flat[:, :2]).sum(-1, keepdim=True)
    turned = torch.cat([slope, by_z], -1) @ small.rotation.mT
    return turned / depth[:, None, :, None]
