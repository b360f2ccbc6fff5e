"""Multiresolution hash encoding (Mueller et al. 2022, "Instant Neural Graphics Primitives", section 3).

Pure torch, laid out for the cores of a CPU; on a GPU, ``fused`` has a kernel for it:

* arrays are (corner, point), so that all arithmetic runs along contiguous points;
* a pair of features is read and accumulated as one complex number (a "unit" below): one memory access per corner;
* the points go through a level in chunks whose temporaries stay in the cache, as does the table of the level;
* levels are computed on several threads at once, because torch gathers and scatters on a single thread;
* the backward pass is written by hand: gradients to a table are scattered to recomputed corner indices, and the
  derivative with respect to position is kept from the forward pass, where the corner values are at hand anyway.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from bidnerf_core.errors import InputError
from bidnerf_core.settings import Range, Settings
from bidnerf_hashgrid import fused
from bidnerf_hashgrid.levels import Level, make_levels
from bidnerf_hashgrid.threads import concurrently, slices, threads_for

CHUNK = 32768
"""Number of points computed at once."""


@dataclass(frozen=True)
class HashEncodingConfig(Settings):
    """Hyperparameters of table 1 of the paper: L, F, log2 T, N_min and N_max.

    The interpolation ``smooth`` passes the position in a cell through 3t^2 - 2t^3 (appendix A), so that the derivative
    of the encoding with respect to position is continuous.
    """

    levels: Annotated[int, Range(1, 64)] = 16  # number of levels of resolution
    features: Annotated[int, Range(1, 64)] = 2  # features per table entry; even numbers are faster
    log2_table_size: Annotated[int, Range(1, 30)] = 19  # entries of a level's table, as a power of two
    base_resolution: Annotated[float, Range(1, 2**20)] = 16  # cells along a side at the coarsest level
    # cells along a side at the finest level, or their maximum
    finest_resolution: Annotated[float, Range(1, 2**20)] = 512
    # how features are interpolated between the corners of a cell
    interpolation: Literal["linear", "smooth"] = "linear"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.base_resolution > self.finest_resolution:
            raise InputError(
                f"base_resolution is {self.base_resolution}",
                expected=f"{self.finest_resolution} (finest_resolution) or less",
            )


def _weights(fraction: Float[Tensor, "3 m"], smooth: bool, unit: int) -> Float[Tensor, "3 w"]:
    """Return the weight of the upper vertex along each axis (the fraction, or its smoothstep), repeated within a unit."""
    return _repeat(fraction * fraction * (3 - 2 * fraction) if smooth else fraction, unit)


def _repeat(values: Float[Tensor, "*shape m"], unit: int) -> Float[Tensor, "*shape w"]:
    return _as_floats(torch.complex(values, values)) if unit == 2 else values


def _unit(features: int) -> int:
    return 1 if features % 2 else 2


def _as_units(values: Float[Tensor, "*shape w"], unit: int) -> Shaped[Tensor, "*shape n"]:
    """View adjacent pairs of floats as complex numbers if the unit is a pair; otherwise return the values unchanged."""
    return torch.view_as_complex(values.unflatten(-1, (-1, 2))) if unit == 2 else values


def _as_floats(values: Shaped[Tensor, "*shape n"]) -> Float[Tensor, "*shape w"]:
    return torch.view_as_real(values).flatten(-2) if values.is_complex() else values


def _interpolate(corners: Float[Tensor, "2 2 2 w"], weights: Float[Tensor, "3 w"]) -> Float[Tensor, " w"]:
    x, y, z = weights.unbind()
    for weight in (z, y, x):
        corners = torch.lerp(corners[0], corners[1], weight)
    return corners


def _interpolate_with_slopes(
    corners: Float[Tensor, "2 2 2 w"], weights: Float[Tensor, "3 w"]
) -> tuple[Float[Tensor, " w"], list[Float[Tensor, " w"]]]:
    """Return the interpolated value and its derivatives with respect to the weights of x, y and z."""
    x, y, z = weights.unbind()
    slopes: list[Tensor] = []
    for weight in (z, y, x):
        lower, upper = corners.unbind()
        slopes = [upper - lower, *(torch.lerp(slope[0], slope[1], weight) for slope in slopes)]
        corners = torch.addcmul(lower, slopes[0], weight)
    return corners, slopes


def _spread(gradient: Float[Tensor, " w"], weights: Float[Tensor, "3 w"]) -> Float[Tensor, "2 2 2 w"]:
    """Return the gradient to each of the eight corners: the transpose of ``_interpolate``."""
    for weight in weights.unbind():
        corners = gradient.new_empty(2, *gradient.shape)
        torch.mul(gradient, weight, out=corners[1])
        torch.sub(gradient, corners[1], out=corners[0])
        gradient = corners
    return gradient


def _encode_level(
    points: Float[Tensor, "3 n"],
    table: Float[Tensor, "t f"],
    level: Level,
    smooth: bool,
    values: Float[Tensor, "c w"],
    slopes: Float[Tensor, "c 3 w"] | None,
) -> None:
    """Write a level's features to ``values``, and their derivatives with respect to position (in cells) to ``slopes``."""
    unit = _unit(table.shape[1])
    columns = _as_units(table, unit).unbind(1)
    for chunk in slices(points.shape[1], CHUNK):
        wide = slice(chunk.start * unit, chunk.stop * unit)
        terms, fraction = level.vertices(points[:, chunk])
        weights = _weights(fraction, smooth, unit)
        index = level.corner_indices(terms)
        for k, column in enumerate(columns):
            corners = _as_floats(column.index_select(0, index)).view(2, 2, 2, -1)
            if slopes is None:
                values[k, wide] = _interpolate(corners, weights)
            else:
                values[k, wide], by_axis = _interpolate_with_slopes(corners, weights)
                for axis, slope in enumerate(by_axis):
                    slopes[k, axis, wide] = slope
        if slopes is not None and smooth:
            slopes[:, :, wide] *= _repeat(6 * fraction * (1 - fraction), unit)


def _write_table_gradient(
    points: Float[Tensor, "3 n"],
    gradient: Float[Tensor, "c w"],
    level: Level,
    smooth: bool,
    table: Float[Tensor, "t f"],
) -> None:
    """Backpropagate the gradient of a level's features to the table's entries, and write the result to ``table``."""
    unit = _unit(table.shape[1])
    table.zero_()
    for chunk in slices(points.shape[1], CHUNK):
        wide = slice(chunk.start * unit, chunk.stop * unit)
        terms, fraction = level.vertices(points[:, chunk])
        weights = _weights(fraction, smooth, unit)
        # scatter_add_ takes int64 only, and is still twice as fast as index_add_ with int32.
        index = level.corner_indices(terms).long()
        for k, target in enumerate(_as_units(table, unit).unbind(1)):
            corners = _spread(gradient[k, wide], weights).view(-1)
            target.scatter_add_(0, index, _as_units(corners, unit))


class _Encode(torch.autograd.Function):
    """Autograd function of the encoding by all active levels at once.

    Internally, each unit of each level is a contiguous row: a single transposition at the end costs less than
    having each level write to the columns of the result.
    """

    @staticmethod
    def forward(
        ctx: Any,
        points: Float[Tensor, "3 n"],
        levels: tuple[Level, ...],
        total: int,
        smooth: bool,
        want_slopes: bool,
        *tables: Float[Tensor, "_ f"],
    ) -> Float[Tensor, "n width"]:
        count, features = points.shape[1], tables[0].shape[1]
        unit = _unit(features)
        rows = points.new_empty(total, features // unit, count * unit)
        rows[len(levels) :] = 0
        slopes = [points.new_empty(features // unit, 3, count * unit) if want_slopes else None for _ in levels]
        tasks = [
            partial(_encode_level, points, table, level, smooth, row, slope)
            for table, level, row, slope in zip(tables, levels, rows, slopes, strict=False)
        ]
        concurrently(tasks, threads_for(count, points.device))
        ctx.save_for_backward(points, *(slope for slope in slopes if slope is not None))
        ctx.levels, ctx.features, ctx.smooth = levels, features, smooth
        encoded = rows.new_empty(count, total * features)
        _as_units(encoded, unit)[:] = _as_units(rows, unit).flatten(0, 1).t()
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "n width"]) -> tuple[Tensor | None, ...]:
        points, *slopes = ctx.saved_tensors
        unit = _unit(ctx.features)
        if points.device.type == "cpu" and not slopes:  # in training, most points have no gradient
            some = gradient.any(1).nonzero()[:, 0]
            points, gradient = points.index_select(1, some), gradient.index_select(0, some)
        rows = _as_floats(_as_units(gradient.contiguous(), unit).t().contiguous())
        rows = rows.unflatten(0, (-1, ctx.features // unit))
        to_points: Tensor | None = None
        if ctx.needs_input_grad[0]:
            to_points = torch.zeros_like(slopes[0][0])
            for level, slope, row in zip(ctx.levels, slopes, rows, strict=False):
                for by_position, part in zip(slope, row, strict=True):
                    to_points.addcmul_(by_position, part, value=level.resolution)
            to_points = to_points.unflatten(1, (-1, unit)).sum(-1)
        to_tables = [
            points.new_empty(level.entries, ctx.features) if wanted else None
            for level, wanted in zip(ctx.levels, ctx.needs_input_grad[5:], strict=True)
        ]
        tasks = [
            partial(_write_table_gradient, points, row, level, ctx.smooth, table)
            for table, level, row in zip(to_tables, ctx.levels, rows, strict=False)
            if table is not None
        ]
        concurrently(tasks, threads_for(points.shape[1], points.device))
        return to_points, None, None, None, None, *to_tables


class HashEncoding(nn.Module):
    """Maps positions in the unit cube to the concatenated features of all levels (figure 3 of the paper).

    Positions outside [0, 1] are clamped to it: their encoding is that of the nearest point of the cube, and a
    clamped coordinate gets no gradient. Gradients are computed only for inputs that require them. They
    cannot be differentiated again: double backward raises an error.
    """

    def __init__(self, config: HashEncodingConfig) -> None:
        super().__init__()
        self.config = config
        self.levels = make_levels(
            config.levels, 2**config.log2_table_size, config.base_resolution, config.finest_resolution
        )
        # One table per level: an inactive level then has no gradient at all and costs the optimizer nothing.
        self.tables = nn.ParameterList(
            nn.Parameter(torch.empty(level.entries, config.features).uniform_(-1e-4, 1e-4)) for level in self.levels
        )

    @property
    def width(self) -> int:
        """The number of features in a point's encoding."""
        return self.config.levels * self.config.features

    def forward(
        self, positions: Float[Tensor, "n 3"], active_levels: int | None = None
    ) -> Float[Tensor, "n {self.width}"]:
        """Encode positions; levels from ``active_levels`` on are not evaluated, and their features are zeros."""
        levels = self.levels if active_levels is None else self.levels[: max(active_levels, 0)]
        if not levels:
            return self.tables[0].new_zeros(len(positions), self.width)
        points = positions.to(self.tables[0].dtype).clamp(0, 1).t().contiguous()
        want_slopes = torch.is_grad_enabled() and points.requires_grad
        tables = list(self.tables)[: len(levels)]
        smooth = self.config.interpolation == "smooth"
        function = fused.Encode if fused.fits(tables) else _Encode
        encoded: Tensor = function.apply(points, levels, self.config.levels, smooth, want_slopes, *tables)
        return encoded
