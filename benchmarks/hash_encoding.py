"""The hash encoding compared with its plain formulation: time of a forward pass and of its gradients on one core.

The plain formulation is that of the torch fallback in nerfstudio: int64 hashes of all levels at once, one
``table[index]`` for each corner, and an elementwise trilinear interpolation. Both give the same numbers, which is
checked before anything is timed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor, nn

from bidnerf_core.evaluation.provenance import write_record
from bidnerf_hashgrid.encoding import HashEncoding, HashEncodingConfig

RESULTS = Path(__file__).parent / "results"

SEED = 0
MODES = {  # name: (gradient to the tables, gradient to the points)
    "forward": (False, False),
    "forward + table gradient": (True, False),
    "forward + point gradient": (False, True),
    "forward + both gradients": (True, True),
}


class PlainEncoding(nn.Module):
    """Compute the same encoding by straightforward tensor code, with all levels in one table."""

    def __init__(self, ours: HashEncoding) -> None:
        super().__init__()
        size = 2**ours.config.log2_table_size
        self.size, self.levels = size, ours.levels
        self.dense = sum(not level.hashed for level in ours.levels)
        self.resolutions = torch.tensor([level.resolution for level in ours.levels])
        self.strides = torch.tensor([level.strides for level in ours.levels])
        self.offsets = torch.arange(len(ours.levels)) * size
        table = torch.zeros(len(ours.levels), size, ours.config.features)
        for rows, values in zip(table, ours.tables, strict=True):
            rows[: len(values)] = values.detach()
        self.table = nn.Parameter(table.flatten(0, 1))

    def index(self, corner: Tensor) -> Tensor:
        x, y, z = (corner * self.strides).unbind(-1)
        dense = x[:, : self.dense] + y[:, : self.dense] + z[:, : self.dense]
        hashed = torch.bitwise_xor(x[:, self.dense :], y[:, self.dense :])
        hashed = torch.bitwise_xor(hashed, z[:, self.dense :]) % self.size
        return torch.cat((dense, hashed), dim=-1) + self.offsets

    def forward(self, positions: Tensor) -> Tensor:
        scaled = positions[:, None] * self.resolutions[:, None]
        upper, lower = torch.ceil(scaled).type(torch.int32), torch.floor(scaled).type(torch.int32)
        x, y, z = (scaled - lower)[..., None].unbind(-2)

        def corner(*is_upper: bool) -> Tensor:
            axes = [(upper if up else lower)[..., axis] for axis, up in enumerate(is_upper)]
            return self.table[self.index(torch.stack(axes, dim=-1))]

        def along_x(*is_upper: bool) -> Tensor:
            return corner(True, *is_upper) * x + corner(False, *is_upper) * (1 - x)

        def along_y(up: bool) -> Tensor:
            return along_x(True, up) * y + along_x(False, up) * (1 - y)

        return (along_y(True) * z + along_y(False) * (1 - z)).flatten(1)


def evaluate(module: nn.Module, points: Tensor, weight: Tensor, mode: str) -> Tensor:
    """Return the output of one pass; the gradients of ``mode`` are left in place."""
    output: Tensor = module(points)
    if any(MODES[mode]):
        output.backward(weight)
    return output.detach()


def prepare(module: nn.Module, points: Tensor, mode: str) -> None:
    for_table, for_points = MODES[mode]
    module.requires_grad_(for_table).zero_grad()
    points.requires_grad_(for_points).grad = None


def time_of(module: nn.Module, points: Tensor, weight: Tensor, mode: str) -> float:
    """Return the milliseconds of one pass."""
    prepare(module, points, mode)
    start = time.perf_counter()
    evaluate(module, points, weight, mode)
    return 1e3 * (time.perf_counter() - start)


def check_equal(plain: PlainEncoding, ours: HashEncoding, points: Tensor, weight: Tensor) -> None:
    """Raise unless the output and both gradients agree up to rounding."""

    def close(actual: Tensor, expected: Tensor) -> None:
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))

    def run(module: nn.Module) -> tuple[Tensor, Tensor]:
        mode = "forward + both gradients"
        prepare(module, points, mode)
        output = evaluate(module, points, weight, mode)
        assert points.grad is not None
        return output, points.grad

    (expected, to_points_expected), (output, to_points) = run(plain), run(ours)
    close(output, expected)
    # At the border between two cells the derivative has two values, and the plain code returns neither.
    scaled = points.detach()[:, None] * plain.resolutions[:, None]
    inside = (scaled != scaled.floor()).flatten(1).all(dim=1)
    close(to_points[inside], to_points_expected[inside])
    assert plain.table.grad is not None
    for expected, table in zip(plain.table.grad.split(plain.size), ours.tables, strict=True):
        assert table.grad is not None
        close(table.grad, expected[: len(table)])


def compare(plain: Callable[[], float], ours: Callable[[], float], repeats: int) -> dict[str, float]:
    """Time the two alternately, so that a change in the machine's speed affects both."""
    plain(), ours()
    times = [(plain(), ours()) for _ in range(repeats)]
    plain_ms, ours_ms = (statistics.median(column) for column in zip(*times, strict=True))
    ratio = statistics.median(slow / fast for slow, fast in times)
    return {"plain_ms": round(plain_ms, 1), "ours_ms": round(ours_ms, 1), "ratio": round(ratio, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--points", type=int, default=131072)
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(SEED)
    config = HashEncodingConfig()
    ours = HashEncoding(config)
    plain = PlainEncoding(ours)
    points, weight = torch.rand(arguments.points, 3), torch.randn(arguments.points, ours.width)
    check_equal(plain, ours, points, weight)
    results: dict[str, object] = {"points": arguments.points, "repeats": arguments.repeats}
    results["config"] = vars(config)
    for mode in MODES:
        row = compare(
            partial(time_of, plain, points, weight, mode),
            partial(time_of, ours, points, weight, mode),
            arguments.repeats,
        )
        results[mode] = row
        print(
            f"{mode:26} plain {row['plain_ms']:7.1f} ms   ours {row['ours_ms']:6.1f} ms   {row['ratio']:.1f}x"
        )
    print("written:", write_record(RESULTS / "hash_encoding.json", results, SEED).name)


if __name__ == "__main__":
    main()
