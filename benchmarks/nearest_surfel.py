r"""The look-up of the nearest surfel, where the search by depth spends its time: sparse index against a dense grid.

    python benchmarks/nearest_surfel.py MAP [MAP ...] --name nearest_surfel

The dense grid has the cells of the map's index and one surfel for each of them; its look-up is that of versions before the
index was sparse. Both look up the same points, with the numbers of poses and points of the search's stages, alternating in one
process of one thread; the ratio is the median over the pairs.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bidnerf_core import load_map
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.mapping import SurfaceMap

RESULTS = Path(__file__).resolve().parent / "results"
STAGES = ((4000, 48), (96, 48), (24, 100), (6, 400), (2, 2000))
"""Numbers of poses and of points of each stage of the search."""


def seconds(look_up: Callable[[Tensor], Tensor], points: Tensor) -> float:
    began = time.perf_counter()
    look_up(points)
    return time.perf_counter() - began


def dense_cells(surface: SurfaceMap) -> Tensor:
    """Return the surfel of each cell of the grid, int32."""
    grid = surface.grid
    slabs = []
    for x in range(grid.shape[0]):
        axes = [torch.tensor([x]), *(torch.arange(count) for count in grid.shape[1:])]
        cell = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
        slabs.append(surface.nearest(torch.tensor(grid.lower) + (cell + 0.5) * grid.cell).int())
    return torch.cat(slabs)


def compared(surface: SurfaceMap, repeats: int) -> dict[str, Any]:
    """Return the median times of both look-ups for each stage, and the median of their ratios."""
    grid, cells = surface.grid, dense_cells(surface)
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(grid.lower), torch.tensor(grid.upper)
    found = {}
    for poses, count in STAGES:
        points = low + (high - low) * torch.rand((poses, count, 3), generator=generator)
        pairs = []
        for _ in range(repeats + 3):
            sparse = seconds(surface.nearest, points)
            pairs.append((sparse, seconds(lambda p: grid.at(cells, p).long(), points)))
        sparse, dense = (statistics.median(times) for times in zip(*pairs[3:], strict=True))
        same = float((surface.nearest(points) == grid.at(cells, points)).double().mean())
        ratio = statistics.median(s / d for s, d in pairs[3:])
        found[f"{poses} poses x {count} points"] = {
            "sparse_ms": 1000 * sparse, "dense_ms": 1000 * dense, "ratio": ratio, "same_surfel": same,
        }  # fmt: skip
    sizes = {"sparse_MB": surface.index.bytes / 1e6, "dense_MB": 4 * cells.numel() / 1e6}
    return {"cell": surface.cell, **sizes, "stages": found}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("maps", nargs="+", type=Path)
    parser.add_argument("--name", default="nearest_surfel", help="of the record")
    parser.add_argument("--repeats", type=int, default=60)
    given = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {}
    for folder in given.maps:
        surface = load_map(folder).surface
        if surface is None:
            raise SystemExit(f"{folder}: has no surface, expected a baked map")
        results[folder.name] = compared(surface, given.repeats)
        print(folder, results[folder.name], flush=True)
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))


if __name__ == "__main__":
    main()
