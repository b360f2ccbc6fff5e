"""Multiresolution hash encoding (Mueller et al. 2022, "Instant Neural Graphics Primitives", section 3).

Pure torch, laid out for the cores of a CPU and equally usable on a GPU:

* arrays are (corner, point), so that all arithmetic runs along contiguous points;
* a pair of features is read and accumulated as one complex number: one memory access a corner (a "unit" below);
* the points go through a level in chunks whose temporaries stay in the cache, and so does the table of the level;
* levels are computed on several threads at once, because torch gathers and scatters on one;
* the backward pass is written by hand: gradients to a table are scattered to recomputed corner indices, and the
  derivative by position is kept from the forward pass, where the corner values are at hand anyway.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from bidnerf_core.constants import constant
from bidnerf_core.errors import InputError
from bidnerf_core.settings import Range, Settings
from bidnerf_hashgrid.threads import concurrently, slices, threads_for

# The primes of eq. 4, modulo 2^32 and signed: int32 products wrap, and only their low bits are used.
PRIMES = (1, 2654435761 - 2**32, 805459861)
CPU_CHUNK = 32768


@dataclass(frozen=True)
class HashEncodingConfig(Settings):
    """Hyperparameters of table 1 of the paper: L, F, log2 T, N_min and N_max.

    The interpolation ``smooth`` passes the position in a cell through 3t^2 - 2t^3 (appendix A), so that the derivative
    of the encoding by position is continuous.
    """

    levels: Annotated[int, Range(1, 64)] = 16  # number of levels of resolution
    features: Annotated[int, Range(1, 64)] = 2  # number of features of an entry; even numbers are faster
    log2_table_size: Annotated[int, Range(1, 30)] = 19  # entries of a level's table, as a power of two
    base_resolution: Annotated[float, Range(1, 2**20)] = 16  # cells along a side at the coarsest level
    finest_resolution: Annotated[float, Range(1, 2**20)] = 512  # cells along a side at the finest level
    # how features are interpolated between the corners of a cell
    interpolation: Literal["linear", "smooth"] = "linear"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.base_resolution > self.finest_resolution:
            raise InputError(
                f"base_resolution is {self.base_resolution}, expected {self.finest_resolution} (finest_resolution) or less"
            )


@dataclass(frozen=True)
class _Level:
    resolution: int
    entries: int
    strides: tuple[int, int, int]
    hashed: bool
    smooth: bool


def _make_levels(config: HashEncodingConfig) -> tuple[_Level, ...]:
    """Return the levels, with resolutions by eqs. 2 and 3; one whose vertices fit in the table is stored without a hash."""
    growth = math.log(config.finest_resolution / config.base_resolution) / max(config.levels - 1, 1)
    levels = []
    for index in range(config.levels):
        # The small addend keeps an exact product, such as N_max itself, from being rounded down.
        resolution = math.floor(config.base_resolution * math.exp(growth * index) + 1e-6)
        side, table_size = resolution + 1, 2**config.log2_table_size
        hashed = side**3 > table_size
        strides = PRIMES if hashed else (1, side, side**2)
        entries = table_size if hashed else side**3
        levels.append(_Level(resolution, entries, strides, hashed, config.interpolation == "smooth"))
    return tuple(levels)


def _vertices(
    points: Float[Tensor, "3 n"], level: _Level
) -> tuple[Int[Tensor, "3 2 n"], Float[Tensor, "3 n"]]:
    """Return the terms of the lower and upper vertex of each axis in a corner's index, and the position in the cell."""
    scaled = points * level.resolution
    # A coordinate of exactly 1 belongs to the last cell, whose upper vertices exist.
    lower = scaled.to(torch.int32).clamp_(0, level.resolution - 1)
    strides = constant(level.strides, lower)[:, None]
    terms = lower.new_empty(3, 2, lower.shape[1])
    torch.mul(lower, strides, out=terms[:, 0])
    torch.add(terms[:, 0], strides, out=terms[:, 1])
    return terms.bitwise_and_(level.entries - 1) if level.hashed else terms, scaled.sub_(lower)


def _corner_indices(terms: Int[Tensor, "3 2 m"], level: _Level) -> Int[Tensor, " 8*m"]:
    """Return the table indices of the eight corners (eq. 4, or the dense index), ordered (z, y, x, point)."""
    combine = torch.bitwise_xor if level.hashed else torch.add
    x, y, z = terms.unbind()
    return combine(combine(z[:, None], y)[:, :, None], x).view(-1)


def _weights(fraction: Float[Tensor, "3 n"], level: _Level, unit: int) -> Float[Tensor, "3 w"]:
    """Return the weight of the upper vertex by axis (the fraction, or its smoothstep), repeated within a unit."""
    return _repeat(fraction * fraction * (3 - 2 * fraction) if level.smooth else fraction, unit)


def _repeat(values: Float[Tensor, "3 n"], unit: int) -> Float[Tensor, "3 w"]:
    return _as_floats(torch.complex(values, values)) if unit == 2 else values


def _unit(features: int) -> int:
    return 1 if features % 2 else 2


def _as_units(values: Float[Tensor, "*shape w"], unit: int) -> Shaped[Tensor, "*shape n"]:
    """Return a view of adjacent pairs of floats as complex numbers, if the unit is a pair."""
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
    """Return the interpolated value and its derivatives by the weights of x, y and z."""
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


def _chunks(points: Float[Tensor, "3 n"]) -> list[slice]:
    count = points.shape[1]
    return slices(count, CPU_CHUNK if points.device.type == "cpu" else max(count, 1))


def _encode_level(
    points: Float[Tensor, "3 n"],
    table: Float[Tensor, "t f"],
    level: _Level,
    values: Float[Tensor, "c w"],
    slopes: Float[Tensor, "c 3 w"] | None,
) -> None:
    """Write the features of a level to ``values``, and their derivatives by position in cells to ``slopes``."""
    unit = _unit(table.shape[1])
    columns = _as_units(table, unit).unbind(1)
    for chunk in _chunks(points):
        wide = slice(chunk.start * unit, chunk.stop * unit)
        terms, fraction = _vertices(points[:, chunk], level)
        weights = _weights(fraction, level, unit)
        index = _corner_indices(terms, level)
        for k, column in enumerate(columns):
            corners = _as_floats(column.index_select(0, index)).view(2, 2, 2, -1)
            if slopes is None:
                values[k, wide] = _interpolate(corners, weights)
            else:
                values[k, wide], by_axis = _interpolate_with_slopes(corners, weights)
                for axis, slope in enumerate(by_axis):
                    slopes[k, axis, wide] = slope
        if slopes is not None and level.smooth:
            slopes[:, :, wide] *= _repeat(6 * fraction * (1 - fraction), unit)


def _add_table_gradient(
    points: Float[Tensor, "3 n"], gradient: Float[Tensor, "c w"], level: _Level, table: Float[Tensor, "t f"]
) -> None:
    """Add the gradient of a level's features, carried back to its entries, to ``table``."""
    unit = _unit(table.shape[1])
    for chunk in _chunks(points):
        wide = slice(chunk.start * unit, chunk.stop * unit)
        terms, fraction = _vertices(points[:, chunk], level)
        weights = _weights(fraction, level, unit)
        # scatter_add_ takes int64 only, and is still twice as fast as index_add_ with int32.
        index = _corner_indices(terms, level).long()
        for target, row in zip(_as_units(table, unit).unbind(1), gradient, strict=True):
            corners = _spread(row[wide], weights).view(-1)
            target.scatter_add_(0, index, _as_units(corners, unit))


class _Encode(torch.autograd.Function):
    """All active levels at once. Inside, each unit of each level is a contiguous row; a level writing into the
    columns of the result by itself costs more than one transposition at the end.
    """

    @staticmethod
    def forward(
        ctx: Any,
        points: Float[Tensor, "3 n"],
        levels: tuple[_Level, ...],
        total: int,
        want_slopes: bool,
        *tables: Float[Tensor, "_ f"],
    ) -> Float[Tensor, "n width"]:
        count, features = points.shape[1], tables[0].shape[1]
        unit = _unit(features)
        rows = points.new_empty(total, features // unit, count * unit)
        rows[len(levels) :] = 0
        slopes = [
            points.new_empty(features // unit, 3, count * unit) if want_slopes else None for _ in levels
        ]
        parts = zip(tables, levels, rows[: len(levels)], slopes, strict=True)
        tasks = [partial(_encode_level, points, *part) for part in parts]
        concurrently(tasks, threads_for(points.shape[1], points.device))
        ctx.save_for_backward(points, *(slope for slope in slopes if slope is not None))
        ctx.levels, ctx.features = levels, features
        encoded = rows.new_empty(count, total * features)
        _as_units(encoded, unit)[:] = _as_units(rows, unit).flatten(0, 1).t()
        return encoded

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "n width"]) -> tuple[Tensor | None, ...]:
        points, *slopes = ctx.saved_tensors
        unit = _unit(ctx.features)
        rows = _as_floats(_as_units(gradient.contiguous(), unit).t().contiguous())
        rows = rows.unflatten(0, (-1, ctx.features // unit))
        to_points: Tensor | None = None
        if ctx.needs_input_grad[0]:
            to_points = torch.zeros_like(slopes[0][0])
            for level, slope, part in zip(ctx.levels, slopes, rows, strict=False):
                for k in range(len(part)):
                    to_points.addcmul_(slope[k], part[k], value=level.resolution)
            to_points = to_points.unflatten(1, (-1, unit)).sum(-1)
        to_tables = [
            points.new_zeros(level.entries, ctx.features) if needed else None
            for level, needed in zip(ctx.levels, ctx.needs_input_grad[4:], strict=True)
        ]
        tasks = [
            partial(_add_table_gradient, points, part, level, table)
            for part, level, table in zip(rows[: len(to_tables)], ctx.levels, to_tables, strict=True)
            if table is not None
        ]
        concurrently(tasks, threads_for(points.shape[1], points.device))
        return to_points, None, None, None, *to_tables


class HashEncoding(nn.Module):
    """Maps positions in the unit cube to the concatenated features of all levels (figure 3 of the paper).

    Positions outside of [0, 1] are clamped to it: their encoding is that of the nearest point of the cube, and a
    clamped coordinate gets no gradient. Gradients are computed only for what requires them. They cannot be
    differentiated again: double backward raises an error.
    """

    def __init__(self, config: HashEncodingConfig) -> None:
        super().__init__()
        self.config = config
        self.levels = _make_levels(config)
        # One table per level: an inactive level has no gradient at all and so costs the optimizer nothing.
        self.tables = nn.ParameterList(
            nn.Parameter(torch.empty(level.entries, config.features).uniform_(-1e-4, 1e-4))
            for level in self.levels
        )

    @property
    def width(self) -> int:
        """Length of the encoding of a point."""
        return self.config.levels * self.config.features

    def forward(
        self, positions: Float[Tensor, "n 3"], active_levels: int | None = None
    ) -> Float[Tensor, "n {self.width}"]:
        """Encode positions; levels from ``active_levels`` on are not evaluated and come back as zeros."""
        levels = self.levels if active_levels is None else self.levels[: max(active_levels, 0)]
        if not levels:
            return self.tables[0].new_zeros(len(positions), self.width)
        points = positions.to(self.tables[0].dtype).clamp(0, 1).t().contiguous()
        want_slopes = torch.is_grad_enabled() and points.requires_grad
        tables = list(self.tables)[: len(levels)]
        encoded: Tensor = _Encode.apply(points, levels, self.config.levels, want_slopes, *tables)
        return encoded
