"""The noise and step size of measured depth, estimated from one depth image.

The noise is the deviation of pixels from locally fitted planes; the step size is the spacing of the distinct
values.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.depth.sensors import DepthNoise, find_depth_sensor
from bidnerf_core.geometry import MAD_TO_SIGMA

WINDOW_SIDE = 8
"""Side, in pixels, of the square windows to which planes are fitted."""
PLANAR = 0.25
"""Quantile of the windows' residuals: this fraction is assumed planar. The others may show edges, curved
surfaces and relief."""
QUANTILE_BIAS = 1.11
"""Ratio of the noise to that quantile if all windows are planar and all pixels independent."""
LEAST_WINDOWS = 20
"""Minimum number of windows in a depth range from which its noise is estimated."""
DEPTH_RANGES = 8
"""Maximum number of depth ranges, with equal numbers of windows."""
ENOUGH_SPREAD = 1.5
"""Minimum ratio of the farthest to the nearest range for which the growth of the noise with depth is estimated."""
REPEATED = 4
"""Minimum mean number of pixels per depth value; below it, depth is continuous or most of its possible values do not occur."""
RANGE_VALUES, MOST_RANGES = 8, 40
"""Minimum number of distinct values in a depth range for taking their median spacing, and maximum number of ranges."""
LEAST_LINES, MOST_LINES = 8, 0.8
"""Minimum number of distinct rows (and columns) of a resampled depth image, and their maximum fraction of the total."""
BETTER = 2.0
"""Factor by which the misfit of constant steps must exceed that of growing steps for growing steps to be assumed."""


def estimated_depth_noise(depth: Float[Tensor, "h w"], intrinsics: Intrinsics) -> DepthNoise | None:
    """Return the noise of a depth image (planar z, metres, 0: not measured), as a function of the depth.

    Its relative noise is constant or grows linearly, ``linear + quadratic * z``; it is fitted to the larger
    of the robust residuals of local planes and the rounding of stored values. Returns None if too few windows
    are measured without gaps. Errors shared by neighbouring pixels go unnoticed, such as those of a warped
    image, or of a lidar whose measurements were interpolated. If hardly any window is planar, relief of the
    scene counts as noise.
    """
    if min(depth.shape) < WINDOW_SIDE:
        return None
    windows = _residuals(depth, intrinsics)
    if len(windows) < LEAST_WINDOWS:
        return None
    ranges = _by_depth(windows, depth_steps(depth))
    return _fitted(ranges)


def _residuals(depth: Float[Tensor, "h w"], intrinsics: Intrinsics) -> Float[Tensor, "n 2"]:
    """Return the median depth (metres) of each window without gaps, and its relative noise about the fitted
    plane.

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
    from scipy.optimize import nnls  # imported here, since it takes as long as the rest of scipy

    (linear, quadratic), _ = nnls(np.stack([np.ones_like(depth), depth], axis=-1), noise)
    return DepthNoise(linear=float(linear), quadratic=float(quadratic))


def noise_remark(depth: Float[Tensor, "h w"], intrinsics: Intrinsics, sensor: str) -> str | None:
    """Return one line that compares the noise estimated from a depth image (metres) with that of a named
    sensor.

    Returns None if the noise cannot be estimated from the image.
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
    return (
        f"depth noise at {z:.3g} m is about {estimated:.2%}; {sensor!r} usually has"
        f" {expected:.2%}{of_disparity}"
    )


@dataclass(frozen=True)
class DepthSteps:
    """The spacing of adjacent depth values: the larger of a constant and a multiple of the squared depth."""

    constant: float  # metres: the unit in which depth is stored
    quadratic: float  # metres per square metre; 0 unless depth was computed from integer steps of disparity

    @property
    def of_disparity(self) -> bool:
        """Whether the steps grow with the square of the depth, like those of a sensor that measures disparity."""
        return self.quadratic > 0

    def step(self, depth: float) -> float:
        """Return the spacing (metres) at a depth (metres)."""
        return max(self.constant, self.quadratic * depth**2)

    def deviation(self, depth: float) -> float:
        """Return the standard deviation (metres) of the rounding error, which is uniform within a step."""
        return self.step(depth) / math.sqrt(12)


def depth_steps(depth: Float[Tensor, "h w"]) -> DepthSteps | None:
    """Return the step size of a depth image (metres, 0: not measured), or None if its values are continuous
    or too few.

    Depth in whole millimetres has the same spacing everywhere. If a disparity d is measured in integer steps,
    the spacing of the depth ``f b / d`` is proportional to its square. The same holds for the rows of an
    exact image of a floor, which cannot be distinguished from that.
    """
    rows, columns = lines_of_sensor(depth)
    depth = depth[rows][:, columns]
    measured = depth[(depth > 0) & depth.isfinite()].double().cpu()
    values, counts = measured.unique(return_counts=True)
    if len(values) < RANGE_VALUES or len(measured) < REPEATED * len(values):
        return None
    spacings = _spacings(values, counts)
    return None if not len(spacings) else _fitted_steps(spacings)


def lines_of_sensor(depth: Float[Tensor, "h w"]) -> tuple[Int[Tensor, "r"], Int[Tensor, "c"]]:
    """Return the indices of the rows and columns that do not repeat the one before.

    If the sensor's resolution is lower than the image's, depth was resampled by nearest neighbour: repeated
    pixels are not separate measurements. All lines are returned if few of them repeat another, such as empty
    ones along a border, and if hardly any would be left, as in an exact image of a wall.
    """
    found = []
    for lines in (depth, depth.T):
        new = torch.ones(len(lines), dtype=torch.bool, device=depth.device)
        new[1:] = (lines[1:] != lines[:-1]).any(-1)
        found.append(new.nonzero()[:, 0])
    if any(
        not LEAST_LINES <= len(some) <= MOST_LINES * size
        for some, size in zip(found, depth.shape, strict=True)
    ):
        found = [torch.arange(size, device=depth.device) for size in depth.shape]
    rows, columns = found
    return rows, columns


def _spacings(values: Float[Tensor, "v"], counts: Tensor) -> Float[Tensor, "b 2"]:
    """Return the median depth and the median spacing of the values in depth ranges in which nearly all values occur."""
    ranges, found = min(MOST_RANGES, len(values) // RANGE_VALUES), []
    for some, pixels in zip(values.tensor_split(ranges), counts.tensor_split(ranges), strict=True):
        if int(pixels.sum()) >= REPEATED * len(some):
            found.append(torch.stack([some.median(), some.diff().median()]))
    return torch.stack(found) if found else torch.zeros((0, 2), dtype=values.dtype)


def _fitted_steps(spacings: Float[Tensor, "b 2"]) -> DepthSteps:
    """Return the best fit to the logarithms of the spacings, among steps that match some of the spacings exactly."""
    depth, gap = spacings.unbind(-1)
    units, factors = gap.unique(), gap / depth.square()
    same = (gap.log() - units.log()[:, None]).abs().mean(-1)
    growing = torch.maximum(units[:, None, None], factors[:, None] * depth.square())
    misfit = (gap.log() - growing.log()).abs().mean(-1)
    best = int(misfit.argmin())
    unit, factor = units[best // len(factors)], factors[best % len(factors)]
    if float(same.min()) <= BETTER * float(misfit.min()) + 1e-3:
        return DepthSteps(float(units[same.argmin()]), 0.0)
    return DepthSteps(float(unit), float(factor))
