"""The steps in which a sensor measures depth, estimated from the distinct values of one depth image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

REPEATED = 4
"""Minimum mean number of pixels per depth value; below it, depth is continuous or most of its possible values do not occur."""
RANGE_VALUES, MOST_RANGES = 8, 40
"""Minimum number of distinct values in a depth range, of which the median spacing is taken, and maximum number of ranges."""
LEAST_LINES, MOST_LINES = 8, 0.8
"""Minimum number of distinct rows (and columns) of a resampled depth image, and their maximum share of all of them."""
BETTER = 2.0
"""Factor by which the misfit of constant steps must exceed that of growing steps for growing steps to be assumed."""


@dataclass(frozen=True)
class DepthSteps:
    """The spacing of adjacent depth values: the larger of a constant and a multiple of the squared depth."""

    constant: float  # metres: the unit in which depth is stored
    quadratic: float  # metres per square metre; 0 where depth was not computed from whole steps of disparity

    @property
    def of_disparity(self) -> bool:
        """Whether the steps grow with the square of the depth, like those of a sensor that measures disparity."""
        return self.quadratic > 0

    def step(self, depth: float) -> float:
        """Return the spacing (metres) at a depth (metres)."""
        return max(self.constant, self.quadratic * depth**2)

    def deviation(self, depth: float) -> float:
        """Return the standard deviation (metres) of the rounding to whole steps, whose error is uniform."""
        return self.step(depth) / math.sqrt(12)


def depth_steps(depth: Float[Tensor, "h w"]) -> DepthSteps | None:
    """Return the steps of a depth image (metres, 0: not measured), or None where its values are continuous or too few.

    Depth in whole millimetres has the same spacing everywhere. Where a disparity d is measured in whole steps, the spacing
    of the depth ``f b / d`` is proportional to its square. The same holds for the rows of an exact image of a floor, which
    cannot be distinguished from that.
    """
    rows, columns = lines_of_sensor(depth)
    depth = depth[rows][:, columns]
    measured = depth[(depth > 0) & depth.isfinite()].double().cpu()
    values, counts = measured.unique(return_counts=True)
    if len(values) < RANGE_VALUES or len(measured) < REPEATED * len(values):
        return None
    spacings = _spacings(values, counts)
    return None if not len(spacings) else _fitted(spacings)


def lines_of_sensor(depth: Float[Tensor, "h w"]) -> tuple[Int[Tensor, "r"], Int[Tensor, "c"]]:
    """Return the numbers of the rows and columns that do not repeat the one before.

    Depth whose sensor has a lower resolution than the image was resampled to the nearest measurement: repeated pixels are not
    separate measurements. All lines are returned where few repeat another, such as empty ones along a border, and where
    hardly any would be left, as in an exact image of a wall.
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
    """Return the median depth and the median spacing of the values in depth ranges where nearly all values occur."""
    ranges, found = min(MOST_RANGES, len(values) // RANGE_VALUES), []
    for some, pixels in zip(values.tensor_split(ranges), counts.tensor_split(ranges), strict=True):
        if int(pixels.sum()) >= REPEATED * len(some):
            found.append(torch.stack([some.median(), some.diff().median()]))
    return torch.stack(found) if found else torch.zeros((0, 2), dtype=values.dtype)


def _fitted(spacings: Float[Tensor, "b 2"]) -> DepthSteps:
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
