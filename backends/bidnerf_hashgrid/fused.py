"""Launches of kernels for the encoding, the whole field and its sampler, where Triton is installed and the field is on a GPU.

Kernels are imported where they are launched, since Triton may be missing. Triton launches on the current device, which
may differ from the field's device.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.util import find_spec
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad

from bidnerf_core.devices import constant
from bidnerf_core.fields import Rays, RaySamples, SceneBounds
from bidnerf_hashgrid.concentration import EVEN_SHARE, LARGEST_THICKNESS, TAIL
from bidnerf_hashgrid.levels import Level

MOST = 96
"""Maximum number of samples per ray if the host must not wait to count them; the nearest ones in occupied cells are kept."""
WIDEST = 128
"""Features of the encoding, and units of a layer, up to which a field's tiles fit into the registers of a GPU."""
POINTS = 64
"""Number of points in a tile; doubled for the field's values without derivatives, and for the steps of a ray looked up at once."""


@lru_cache(maxsize=4)
def available(device: torch.device) -> bool:
    """Return whether the kernels can run on ``device``."""
    return device.type == "cuda" and find_spec("triton") is not None


def fits(tables: Sequence[Tensor]) -> bool:
    """Return whether the kernels can encode with these tables: float32, on a suitable GPU, small enough for 32-bit indices."""
    small = all(table.dtype == torch.float32 and table.numel() < 2**31 for table in tables)
    return small and available(tables[0].device)


def _power_of_two(size: int) -> int:
    return max(16, 1 << (size - 1).bit_length())


def _launch(levels: Sequence[Level], tables: Sequence[Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the levels' constants, the first table, and the offset of each table from the first, in elements."""
    columns = zip(*((a.resolution, a.entries, int(a.hashed), *a.strides[1:]) for a in levels), strict=True)
    first, size = tables[0].data_ptr(), tables[0].element_size()
    offsets = tuple((table.data_ptr() - first) // size for table in tables)
    ints = torch.empty(0, dtype=torch.int32, device=tables[0].device)
    meta = constant(tuple(number for row in columns for number in row), ints)
    return meta, tables[0], constant(offsets, ints.long())


def _blocks(count: int, size: int) -> tuple[int]:
    return (max(1, -(-count // size)),)


class Encode(torch.autograd.Function):
    """Autograd function that encodes points (3 n) in the unit cube with some levels, and writes zeros for the others."""

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
        from bidnerf_hashgrid.kernels import encode_kernel

        n, features = points.shape[1], tables[0].shape[1]
        width = total * features
        values = points.new_empty(n, width)
        slopes = points.new_empty((3, n, width) if want_slopes else (0,))
        with torch.cuda.device_of(points):
            encode_kernel[_blocks(n, POINTS)](
                points,
                values,
                slopes,
                *_launch(levels, tables),
                n,
                width,
                LEVELS=len(levels),
                F=features,
                C=_power_of_two(width),
                SMOOTH=smooth,
                SLOPES=want_slopes,
                BLOCK=POINTS,
            )
        ctx.save_for_backward(points, slopes)
        ctx.levels, ctx.smooth, ctx.features = levels, smooth, features
        return values

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Float[Tensor, "n width"]) -> tuple[Tensor | None, ...]:
        from bidnerf_hashgrid.kernels import scatter_kernel

        points, slopes = ctx.saved_tensors
        levels, needed = ctx.levels, ctx.needs_input_grad[5:]
        to_points = (slopes * gradient).sum(-1) if ctx.needs_input_grad[0] else None
        if not any(needed):
            return to_points, None, None, None, None, *([None] * len(needed))
        flat = points.new_zeros(sum(level.entries for level in levels), ctx.features)
        parts = flat.split([level.entries for level in levels])
        n, width = gradient.shape
        with torch.cuda.device_of(points):
            scatter_kernel[_blocks(n, POINTS)](
                points,
                gradient.contiguous(),
                *_launch(levels, parts),
                n,
                width,
                LEVELS=len(levels),
                F=ctx.features,
                C=_power_of_two(width),
                SMOOTH=ctx.smooth,
                BLOCK=POINTS,
            )
        gradients = [part if wanted else None for part, wanted in zip(parts, needed, strict=True)]
        return to_points, None, None, None, None, *gradients


@dataclass(frozen=True, eq=False)
class PackedNetworks:
    """The weights of both networks as the field's kernel reads them: transposed, padded with zeros, in one tensor."""

    first: Float[Tensor, "o i"]  # weights of the first layer, whose inputs depend on the level
    rest: Float[Tensor, " w"]
    biases: Float[Tensor, " b"]
    width: int  # of hidden layers
    features: int  # of the density network's results
    hidden: int  # layers between hidden layers of the colour network
    by_inputs: dict[int, Tensor]

    @staticmethod
    def of(geometry: nn.Sequential, colour: nn.Sequential) -> PackedNetworks | None:
        """Return the packed networks, or None if the kernel cannot compute them: it supports one or two hidden layers of colour."""
        first, out_of, into, *between, last = (part for part in (*geometry, *colour) if isinstance(part, nn.Linear))
        width, features = _power_of_two(first.out_features), _power_of_two(out_of.out_features)
        if into is last or len(between) > 1 or max(width, features, first.in_features) > WIDEST:
            return None
        passed = out_of.out_features - 1
        of_features = pad(into.weight[:, :passed].t(), (0, 0, 1, 0))  # none of the log density
        parts = [
            (out_of.weight.t(), width, features),
            (of_features, features, width),
            (into.weight[:, passed:].t(), 16, width),
            *((layer.weight.t(), width, width) for layer in between),
            (last.weight.t(), width, 16),
        ]
        sizes, layers = (
            (width, features, width, *([width] * len(between)), 16),
            (first, out_of, into, *between, last),
        )
        biases = [pad(layer.bias, (0, size - len(layer.bias))) for layer, size in zip(layers, sizes, strict=True)]
        rest = torch.cat([_pad(part, rows, columns).flatten() for part, rows, columns in parts])
        return PackedNetworks(first.weight, rest, torch.cat(biases), width, features, len(between), {})

    def weights(self, inputs: int) -> Float[Tensor, " w"]:
        """Return the weights of all layers; those of the first layer are for its first ``inputs`` inputs only."""
        if inputs not in self.by_inputs:
            into = _pad(self.first[:, :inputs].t(), _power_of_two(inputs), self.width)
            self.by_inputs[inputs] = torch.cat([into.flatten(), self.rest])
        return self.by_inputs[inputs]


def _pad(matrix: Float[Tensor, "i o"], rows: int, columns: int) -> Float[Tensor, "r c"]:
    return pad(matrix, (0, columns - matrix.shape[1], 0, rows - matrix.shape[0]))


def query(
    positions: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    derivatives: bool,
    wanted: Bool[Tensor, "n"] | None,
    packed: PackedNetworks,
    levels: tuple[Level, ...],
    tables: Sequence[Tensor],
    smooth: bool,
    limits: tuple[SceneBounds, float],
) -> tuple[Float[Tensor, "n 4"], Float[Tensor, "n 4 6"]]:
    """Return density and colour at points (metres, world) along unit directions.

    With ``derivatives``, also return the derivatives of density and colour by position and by direction. ``limits`` are the
    scene's bounds and the largest log density per side of the scene. At points that are not ``wanted``, all results are 0.
    """
    from bidnerf_hashgrid.kernels import field_kernel

    n, features = len(positions), tables[0].shape[1]
    bounds, largest = limits
    new = positions.new_empty if wanted is None else positions.new_zeros
    values, by_both = new((n, 4)), new((n, 4, 6) if derivatives else (0,))
    if not n:
        return values, by_both
    box = constant((*bounds.centre, 2 / bounds.side, 1 / bounds.side), values)
    inputs = len(levels) * features
    index = count = torch.empty(0, dtype=torch.long, device=values.device)
    if wanted is not None:  # the wanted points' numbers in order; the host does not wait to count them
        slot = wanted.long().cumsum(0)
        index, count = slot.new_empty(n + 1), slot[-1:]
        index.scatter_(0, torch.where(wanted, slot - 1, n), torch.arange(n, device=slot.device))
    block = POINTS if derivatives else 2 * POINTS
    # Products of derivatives are rounded to TF32; those of values are as exact as single precision.
    with torch.cuda.device_of(values):
        field_kernel[_blocks(n, block)](
            positions.contiguous(),
            directions.contiguous(),
            values,
            by_both,
            index,
            count,
            *_launch(levels, tables),
            packed.weights(inputs),
            packed.biases,
            box,
            n,
            LEVELS=len(levels),
            F=features,
            C=_power_of_two(inputs),
            WIDTH=packed.width,
            FEATURES=packed.features,
            HIDDEN=packed.hidden,
            SMOOTH=smooth,
            CONTRACTED=bounds.contracted,
            LIMIT=largest,
            DERIVATIVES=derivatives,
            SOME=wanted is not None,
            BLOCK=block,
            PRECISION="tf32",
        )
    return values, by_both


def sample(
    rays: Rays,
    bounds: SceneBounds,
    occupied: Bool[Tensor, "n n n"],
    density: Float[Tensor, "n n n"],
    step: float,
    count: int,
    most: int,
    jitter: Generator | None,
) -> RaySamples:
    """Return ``count`` intervals of each ray (r), concentrated where the ``density`` of a grid's cells is high.

    The intervals divide the ray's first ``most`` steps in ``occupied`` cells; if ``count`` is ``most``, they are these steps. The
    result is that of ``OccupancyGrid`` and ``Concentrated``.
    """
    from bidnerf_hashgrid.march import concentrate_kernel, march_kernel

    n, even = len(rays.near), max(2, round(EVEN_SHARE * (count + 1)))
    packed = torch.cat([rays.origins.t(), rays.directions.t(), rays.near[None], rays.far[None]])
    grid = constant((*bounds.centre, bounds.side / 2, step, float(len(occupied))), packed)
    offset, shift = torch.full_like(rays.near, 0.5), packed.new_zeros(n, count + 1)
    if jitter is not None:
        draw = partial(torch.rand, generator=jitter, device=jitter.device)
        offset = draw((n,)).to(offset)
        by_weight, by_length = (draw((n, max(size - 2, 0))).to(shift) for size in (count + 1 - even, even))
        shift[:, 1 : count - even] = (by_weight - 0.5) / (count - even)
        shift[:, count + 2 - even : -1] = (by_length - 0.5) / (even - 1)
    middles, counts = packed.new_empty(n, most), torch.empty(n, dtype=torch.int32, device=packed.device)
    starts, ends = packed.new_empty(n, count), packed.new_empty(n, count)
    valid = torch.empty(n, count, dtype=torch.bool, device=packed.device)
    length = 2 * bounds.side  # a cube's diagonal, and contracted space, are not longer
    steps = _power_of_two(most)
    with torch.cuda.device_of(packed):
        march_kernel[(n,)](
            packed,
            grid,
            offset,
            occupied.view(torch.uint8),
            middles,
            counts,
            n,
            STEPS=math.ceil(length / step) + 1,
            MOST=most,
            CONTRACTED=bounds.contracted,
            CHUNK=2 * POINTS,
        )
        concentrate_kernel[(n,)](
            packed,
            grid,
            middles,
            counts,
            density,
            shift,
            starts,
            ends,
            valid.view(torch.uint8),
            n,
            LARGEST_THICKNESS,
            TAIL,
            COUNT=count,
            EVEN=even,
            MOST=most,
            S=steps,
            J=_power_of_two(count + 1),
            CONTRACTED=bounds.contracted,
            num_warps=max(4, steps // 32),
        )
    return RaySamples(starts, ends, valid)
