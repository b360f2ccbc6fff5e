"""What images would look like from many poses beside what they do look like: the cost of poses, and derivatives of it.

Small images are drawn whole. How their colours change as the camera moves is then known from their own slopes and from how
far away things are, whatever drew them: nothing is differentiated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.localization.sketches import Sketcher
from bidnerf_core.localization.solvers.levenberg_marquardt import System
from bidnerf_core.localization.thumbnails import Thumbnail, slopes, smooth
from bidnerf_core.se3 import SE3

UNKNOWN = 0.7
"""Cost of a pixel that shows what the map does not know."""


@dataclass(frozen=True)
class Looks:
    """How colours are compared."""

    scale: float = 0.2  # of all channels together, each in [0, 1]: a half counts from here on
    gain: float = 0.2  # how far an image's brightness may be other than the map's, as a standard deviation
    bias: float = 0.1


@dataclass(frozen=True, eq=False)
class Drawing:
    """A thumbnail's n pixels as they would look from each of h poses."""

    rgb: Float[Tensor, "h 3 n"]  # smooth
    slopes: Float[Tensor, "h 3 n 2"]  # of it, per unit on the plane z = 1
    known: Float[Tensor, "h n"]  # how much of what a pixel shows is of the map
    points: Float[Tensor, "h n 3"]  # metres, last camera: what is seen
    depth: Float[Tensor, "h n"]  # metres, of the thumbnail's camera


def drawn(sketcher: Sketcher, small: Thumbnail, T: SE3) -> Drawing:
    """From poses T_world_last (h)."""
    camera, count, local = small.camera, len(T.translation), small.directions
    rotation, translation = T.rotation.to(local), T.translation.to(local)
    directions = local @ rotation.mT
    origins = (rotation @ small.origin + translation)[:, None].expand_as(directions)
    seen = sketcher(origins.reshape(-1, 3), directions.reshape(-1, 3))
    rgb, known = (
        smooth(part.reshape(count, camera.height, camera.width, -1).permute(0, 3, 1, 2))
        for part in (seen.rgb, seen.known)
    )
    rgb = rgb / known.clamp(min=1e-3)
    along = seen.along.view(count, -1)
    points = small.origin + along[..., None] * local
    return Drawing(rgb.flatten(2), slopes(rgb, camera), known.flatten(1), points, along * small.directness)


def compared(
    sketcher: Sketcher, thumbnails: Sequence[Thumbnail], looks: Looks, pivot: Float[Tensor, "3"], T: SE3
) -> System:
    """Mean over pixels of ``1 - 1 / (1 + c^2 / s^2)`` with the difference c between drawn and measured colour (Geman and
    McClure 1985), for each of the poses ``T``; updates turn about ``pivot`` (metres, last camera).

    The system is that of iteratively reweighted least squares. A drawing slides over its image as the camera moves; with
    the mean of both slopes, its colours change as to second order (Benhimane and Malis 2004, "Real-time image-based tracking
    of planes using efficient second-order minimization"). Infinite where a pose is not finite.
    """
    parts = [_compared(sketcher, small, looks, pivot, T) for small in thumbnails]
    cost, gradient, hessian = (torch.stack(values).mean(0).double() for values in zip(*parts, strict=True))
    sound = T.translation.isfinite().all(-1) & T.rotation.isfinite().all(-1).all(-1)
    return System(torch.where(sound, cost, torch.inf), gradient, hessian)


def _compared(
    sketcher: Sketcher, small: Thumbnail, looks: Looks, pivot: Float[Tensor, "3"], T: SE3
) -> tuple[Tensor, Tensor, Tensor]:
    seen, measured = drawn(sketcher, small, T), small.rgb.flatten(1)
    error = brightened(seen, measured, looks) - measured
    near = 1 / (1 + (error**2).sum(1) / looks.scale**2)
    cost = (seen.known * (1 - near) + (1 - seen.known) * UNKNOWN).mean(-1)
    weight = seen.known * near**2 / looks.scale**2 / error.shape[-1]
    by_point = _by_point(small, (seen.slopes + small.slopes) / 2, seen.depth)
    arm = (seen.points - pivot)[:, None].expand_as(by_point)
    rows = torch.cat([by_point, torch.linalg.cross(arm, by_point)], -1)
    weighted = (weight[:, None, :, None] * rows).flatten(1, 2)
    gradient = (weighted.mT @ error.flatten(1)[..., None])[..., 0]
    return cost, gradient, weighted.mT @ rows.flatten(1, 2)


def _by_point(
    small: Thumbnail, slope: Float[Tensor, "h 3 n 2"], depth: Float[Tensor, "h n"]
) -> Float[Tensor, "h 3 n 3"]:
    """Change of a pixel's colour by a displacement of the camera, in the last camera's axes, per metre.

    A point (X, Y, Z) is seen at x = X / Z, y = Y / Z, and moves there by (dX - x dZ, dY - y dZ) / Z.
    """
    by_z = -(slope * small.flat[:, :2]).sum(-1, keepdim=True)
    turned = torch.cat([slope, by_z], -1) @ small.T_last_camera.rotation.to(slope).mT
    return turned / depth[:, None, :, None]


def brightened(seen: Drawing, measured: Float[Tensor, "3 n"], looks: Looks) -> Float[Tensor, "h 3 n"]:
    """Drawn colours, as much brighter or darker as brings them nearest to the measured ones, within what is likely."""
    if not (looks.gain and looks.bias):
        return seen.rgb
    rgb = seen.rgb
    for _ in range(2):
        near = 1 / (1 + ((measured - rgb) ** 2).sum(1, keepdim=True) / looks.scale**2)
        rgb = _fitted(seen.rgb, measured, seen.known[:, None] * near**2 / looks.scale**2, looks)
    return rgb


def _fitted(
    rgb: Float[Tensor, "h 3 n"], wanted: Float[Tensor, "3 n"], weight: Float[Tensor, "h 1 n"], looks: Looks
) -> Float[Tensor, "h 3 n"]:
    """``(1 + g) rgb + b`` for each channel: least squares, with g and b likely to be small."""
    off = wanted - rgb
    ones, mean, square = (
        (weight * part).sum(-1, keepdim=True) for part in (torch.ones_like(rgb), rgb, rgb**2)
    )
    ones, square = ones + looks.bias**-2, square + looks.gain**-2
    shift, grow = ((weight * part).sum(-1, keepdim=True) for part in (off, rgb * off))
    determinant = ones * square - mean**2
    return rgb + ((ones * grow - mean * shift) * rgb + square * shift - mean * grow) / determinant
