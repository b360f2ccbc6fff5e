"""The noise of measured depth, estimated from one depth image by the distance of its pixels from locally fitted planes."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import nnls
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.depth.sensors import DepthNoise, find_depth_sensor
from bidnerf_core.depth.steps import DepthSteps, depth_steps, lines_of_sensor
from bidnerf_core.geometry.robust import MAD_TO_SIGMA

WINDOW_SIDE = 8
"""Side, in pixels, of the square windows to which planes are fitted."""
PLANAR = 0.25
"""Quantile of the windows' residuals: this share is assumed planar. The others may show edges, curved surfaces and relief."""
QUANTILE_BIAS = 1.11
"""Ratio of the noise to that quantile where all windows are planar and all pixels independent."""
LEAST_WINDOWS = 20
"""Minimum number of windows in a range of depths from which its noise is estimated."""
DEPTH_RANGES = 8
"""Maximum number of ranges of depths, with equal numbers of windows."""
ENOUGH_SPREAD = 1.5
"""Minimum ratio of the farthest to the nearest range for which the growth of the noise with depth is estimated."""


def estimated_depth_noise(depth: Float[Tensor, "h w"], intrinsics: Intrinsics) -> DepthNoise | None:
    """Return the noise of a depth image (planar z, metres, 0: not measured), as a function of the depth.

    Its relative noise is constant or grows linearly, ``linear + quadratic * z``; it is fitted to the larger of the robust
    residuals of local planes and the rounding of stored values. None where too few windows of the image are measured without
    gaps. Errors that neighbouring pixels share go unnoticed, such as those of a warped image, or what remains of a lidar's
    after interpolation. Where hardly any window is planar, relief of the scene counts as noise.
    """
    if min(depth.shape) < WINDOW_SIDE:
        return None
    windows = _residuals(depth, intrinsics)
    if len(windows) < LEAST_WINDOWS:
        return None
    ranges = _by_depth(windows, depth_steps(depth))
    return _fitted(ranges)


def _residuals(depth: Float[Tensor, "h w"], intrinsics: Intrinsics) -> Float[Tensor, "n 2"]:
    """Return the median depth (metres) of each window without gaps, and its relative noise about a plane.

    The inverse depth of a plane is linear in the image coordinates, whatever its slant. A deviation e of 1/z corresponds to
    a relative deviation ``z e`` of z.
    """
    depth = depth.detach().cpu()
    rows, columns = lines_of_sensor(depth)
    z = _windows(depth[rows][:, columns].double())
    image = intrinsics.unproject(intrinsics.pixel_centres(torch.float64)[rows][:, columns])
    x = torch.stack([_windows(image[..., axis]) for axis in (0, 1)], dim=-1)
    whole = ((z > 0) & z.isfinite()).all(-1)
    z, x = z[whole], x[whole]
    inverse, x = 1 / z, x - x.mean(1, keepdim=True)
    off = inverse - inverse.mean(-1, keepdim=True)
    slope = torch.linalg.solve(x.mT @ x, x.mT @ off[..., None])
    off = off - (x @ slope)[..., 0]
    middle, spare = z.median(-1).values, z.shape[-1] / (z.shape[-1] - 3)
    return torch.stack([middle, MAD_TO_SIGMA * spare**0.5 * middle * off.abs().median(-1).values], dim=-1)


def _windows(image: Float[Tensor, "h w"]) -> Float[Tensor, "n p"]:
    """Return the pixels of adjacent windows, one window per row; left-over rows and columns of the image are not used."""
    return (
        image.unfold(0, WINDOW_SIDE, WINDOW_SIDE)
        .unfold(1, WINDOW_SIDE, WINDOW_SIDE)
        .reshape(-1, WINDOW_SIDE**2)
    )


def _by_depth(windows: Float[Tensor, "n 2"], steps: DepthSteps | None) -> Float[Tensor, "b 2"]:
    """Return the median depth and the relative noise of depth ranges with equal numbers of windows."""
    ordered = windows[windows[:, 0].argsort()]
    count = min(DEPTH_RANGES, len(windows) // LEAST_WINDOWS)
    found = []
    for part in ordered.tensor_split(count):
        middle = float(part[:, 0].median())
        noise = QUANTILE_BIAS * float(part[:, 1].quantile(PLANAR))
        rounding = 0.0 if steps is None else steps.deviation(middle) / middle
        found.append([middle, max(noise, rounding)])
    return torch.tensor(found, dtype=torch.float64)


def _fitted(ranges: Float[Tensor, "b 2"]) -> DepthNoise:
    depth, noise = ranges.numpy().T
    if depth.max() < ENOUGH_SPREAD * depth.min():
        return DepthNoise(linear=float(np.median(noise)))
    (linear, quadratic), _ = nnls(np.stack([np.ones_like(depth), depth], axis=-1), noise)
    return DepthNoise(linear=float(linear), quadratic=float(quadratic))


def noise_remark(depth: Float[Tensor, "h w"], intrinsics: Intrinsics, sensor: str) -> str | None:
    """Return one line that compares the noise estimated from a depth image (metres) with that of the sensor of a name.

    Returns None where the noise cannot be estimated from the image.
    """
    found = estimated_depth_noise(depth, intrinsics)
    if found is None:
        return None
    z = float(depth[depth > 0].median())
    estimated, expected = found.deviation(z) / z, find_depth_sensor(sensor).noise.deviation(z) / z
    steps = depth_steps(depth)
    of_disparity = (
        "; its steps grow with the square of the distance" if steps is not None and steps.of_disparity else ""
    )
    return f"depth noise at {z:.3g} m is about {estimated:.2%}; that of {sensor!r} is usually {expected:.2%}{of_disparity}"
