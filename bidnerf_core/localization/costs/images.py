"""The cost of whole small images: compare renderings of a map from many poses with the photo.

The derivative of a rendered image with respect to the pose follows from the image's gradient and its depth, whatever the
renderer; automatic differentiation is not needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.costs.thumbnails import Thumbnail, slopes, smooth
from bidnerf_core.localization.costs.view_renderers import ViewRenderer
from bidnerf_core.localization.exposure import Exposure, fit_exposure
from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.robust import geman_mcclure_inlier
from bidnerf_core.se3 import SE3

UNKNOWN_COST = 0.7
"""Cost of a pixel for which the map renders nothing."""
IMAGE_EXPOSURE_ROUNDS = 2
"""Rounds of robust reweighting in which the exposure is fitted."""


@dataclass(frozen=True)
class ColourScales:
    """Scales of the comparison of colours, and priors on an image's exposure relative to the map."""

    colour: float = 0.2  # norm of the difference over the three channels at which a pixel is half an inlier
    gain: float = 0.2  # standard deviation of the prior about 1
    bias: float = 0.1  # standard deviation of the prior about 0


@dataclass(frozen=True, eq=False)
class RenderedView:
    """A thumbnail's n pixels as the map renders them from each of h poses."""

    rgb: Float[Tensor, "h 3 n"]  # smooth
    slopes: Float[Tensor, "h 3 n 2"]  # of it, per unit on the plane z = 1
    known: Float[Tensor, "h n"]  # share of the pixel that the map renders, 0 to 1
    points: Float[Tensor, "h n 3"]  # points seen by the pixels: metres, last camera's frame
    depth: Float[Tensor, "h n"]  # metres, in the thumbnail's camera


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
    return RenderedView(
        rgb.flatten(2), slopes(rgb, camera), known.flatten(1), points, along * small.directness
    )


@dataclass(frozen=True, eq=False)
class ImageCost:
    """Mean over pixels of ``1 - 1 / (1 + c^2 / s^2)``, with the difference c between rendered and measured colour.

    Its normal equations are those of iteratively reweighted least squares. With the mean of both images' slopes, colours
    change with the pose to second order (Benhimane and Malis 2004, "Real-time image-based tracking of planes using efficient
    second-order minimization"). Updates turn about ``pivot``. The cost is infinite where a pose is not finite.
    """

    renderer: ViewRenderer
    thumbnails: Sequence[Thumbnail]
    scales: ColourScales
    pivot: Float[Tensor, "3"]  # metres, last camera's frame

    def __call__(self, T: SE3) -> NormalEquations:
        parts = [self._of_thumbnail(small, T) for small in self.thumbnails]
        cost, gradient, hessian = (
            torch.stack(values).mean(0).double() for values in zip(*parts, strict=True)
        )
        sound = T.translation.isfinite().all(-1) & T.rotation.isfinite().all(-1).all(-1)
        return NormalEquations(torch.where(sound, cost, torch.inf), gradient, hessian)

    def _of_thumbnail(self, small: Thumbnail, T: SE3) -> tuple[Tensor, Tensor, Tensor]:
        """Return the cost, its gradient and its Hessian of one image."""
        seen, measured = render_view(self.renderer, small, T), small.rgb.flatten(1)
        error = exposed(seen, measured, self.scales) - measured
        near = geman_mcclure_inlier((error**2).sum(1), self.scales.colour)
        cost = (seen.known * (1 - near) + (1 - seen.known) * UNKNOWN_COST).mean(-1)
        weight = seen.known * near**2 / self.scales.colour**2 / error.shape[-1]
        by_point = _by_point(small, (seen.slopes + small.slopes) / 2, seen.depth)
        arm = (seen.points - self.pivot)[:, None].expand_as(by_point)
        rows = torch.cat([by_point, torch.linalg.cross(arm, by_point)], -1)
        weighted = (weight[:, None, :, None] * rows).flatten(1, 2)
        gradient = (weighted.mT @ error.flatten(1)[..., None])[..., 0]
        return cost, gradient, weighted.mT @ rows.flatten(1, 2)


def exposed(
    seen: RenderedView, measured: Float[Tensor, "3 n"], scales: ColourScales
) -> Float[Tensor, "h 3 n"]:
    """Return the rendered colours at the exposure, within the priors, that brings them nearest to the measured ones."""
    if not (scales.gain and scales.bias):
        return seen.rgb
    exposure: Exposure | None = None
    for _ in range(IMAGE_EXPOSURE_ROUNDS):
        rgb = seen.rgb if exposure is None else exposure.applied(seen.rgb)
        near = geman_mcclure_inlier(((measured - rgb) ** 2).sum(1, keepdim=True), scales.colour)
        weights = seen.known[:, None] * near**2 / scales.colour**2
        exposure = fit_exposure(seen.rgb, measured[None], weights, scales.gain**-2, scales.bias**-2)
    assert exposure is not None  # there is at least one round
    return exposure.applied(seen.rgb)


def _by_point(
    small: Thumbnail, slope: Float[Tensor, "h 3 n 2"], depth: Float[Tensor, "h n"]
) -> Float[Tensor, "h 3 n 3"]:
    """Return the change of each pixel's colour by a displacement of the camera, in the last camera's axes, per metre.

    A point (X, Y, Z) is seen at x = X / Z, y = Y / Z, and moves there by (dX - x dZ, dY - y dZ) / Z.
    """
    by_z = -(slope * small.flat[:, :2]).sum(-1, keepdim=True)
    turned = torch.cat([slope, by_z], -1) @ small.rotation.mT
    return turned / depth[:, None, :, None]
