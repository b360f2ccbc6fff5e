"""One step of ``bid`` on maps of any backends, in one run: time, samples per ray, size of the map.

    python benchmarks/backend_step.py DATA MAP... --name backend_step_lego

All maps render the same 2048 rays of a test frame from the same pose, 0.1 m from the truth, at the level that ``bid`` uses,
with the gradient with respect to the pose (forward and backward). They take turns, so that a change in the machine's load
affects all alike, and medians are reported. Where a level's sampler only skips samples of another one (as in the vanilla
field, by its grid of free space), the step without skipping is timed as well, as ``MAP dense``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.comparison import map_bytes, map_labels
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.fields.contract import FieldValues, RadianceField, RaySampler, SceneBounds, levels
from bidnerf_core.fields.rendering import render
from bidnerf_core.frames.frame import View
from bidnerf_core.frames.pixels import draw, uniform
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import BidConfig
from bidnerf_core.localization.method_settings import objective_of
from bidnerf_core.maps.storage import load_map

RESULTS = Path(__file__).parent / "results"

SETTINGS = BidConfig()
OBJECTIVE = objective_of(SETTINGS.colour, SETTINGS.depth)


@dataclass(frozen=True, eq=False)
class Everywhere:
    """A level with samples from another sampler."""

    level: RadianceField
    sampler: RaySampler

    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        return self.level.query(positions, directions)


@dataclass(frozen=True, eq=False)
class Variant:
    """A map's level to time, and facts about both for the record."""

    view: View  # in the frame of its own camera
    start: SE3  # T_world_camera
    bounds: SceneBounds
    level: RadianceField
    about: dict[str, Any]


def variants(folders: list[Path], data: Path) -> dict[str, Variant]:
    found: dict[str, Variant] = {}
    for name, folder in zip(map_labels([str(f) for f in folders]), folders, strict=True):
        stored = load_map(folder)
        dataset = open_dataset(data, stored.bounds.background)
        (view,) = dataset.views("test", dataset.frame_names("test")[:1])
        start = perturb(view.T_ref_camera, 0.1, 2.0, seed=0)
        level = levels(stored.field)[SETTINGS.descent.level or 0]
        own = View(view.frame, SE3.identity())
        about = {
            "backend": stored.info.backend,
            "map_MiB": map_bytes(folder) / 2**20,
            "config": stored.info.config,
        }
        found[name] = Variant(own, start, stored.bounds, level, about)
        inner = getattr(level.sampler, "sampler", None)
        if isinstance(inner, RaySampler):
            found[f"{name} dense"] = Variant(own, start, stored.bounds, Everywhere(level, inner), about)
    return found


def step(variant: Variant, seed: int) -> tuple[float, float]:
    """Return the seconds of one step, and its samples per ray."""
    began = time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    pixels = draw([variant.view], SETTINGS.descent.rays, uniform, generator)
    delta = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    rays = pixels.rays(variant.start.retract(delta), variant.bounds)
    rendering = render(variant.level, rays, variant.bounds.background)
    OBJECTIVE.loss(rendering, pixels).backward()
    return time.perf_counter() - began, float(rendering.samples.valid.sum()) / SETTINGS.descent.rays


def measured(found: dict[str, Variant], repeats: int) -> dict[str, Any]:
    """Time all variants in turn; the first round warms up."""
    times: dict[str, list[float]] = {name: [] for name in found}
    samples: dict[str, list[float]] = {name: [] for name in found}
    for seed in range(repeats + 1):
        for name, variant in found.items():
            seconds, count = step(variant, seed)
            if seed:
                times[name].append(1000 * seconds)
                samples[name].append(count)
    dense = [name for name in found if name.endswith(" dense")]
    return {
        name: {
            **variant.about,
            "ms": statistics.median(times[name]),
            "ms_each": times[name],
            "samples_per_ray": statistics.fmean(samples[name]),
            "times_faster_than": {
                other: faster(times[name], times[other]) for other in dense if other != name
            },
        }
        for name, variant in found.items()
    }


def faster(mine: list[float], others: list[float]) -> float:
    """Return how many times faster ``mine`` is: the median ratio over the rounds."""
    return statistics.median(b / a for a, b in zip(mine, others, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("maps", type=Path, nargs="+")
    parser.add_argument("--name", required=True, help="of the record")
    parser.add_argument("--repeats", type=int, default=9)
    given = parser.parse_args()
    torch.set_num_threads(1)
    found = measured(variants(given.maps, given.data), given.repeats)
    print(
        write_record(
            RESULTS / f"{given.name}.json",
            {"rays": SETTINGS.descent.rays, "level": SETTINGS.descent.level, "steps": found},
            seed=0,
        )
    )
    for name, row in found.items():
        than = ", ".join(
            f"{ratio:.2f} times as fast as {other}" for other, ratio in row["times_faster_than"].items()
        )
        print(
            f"{name}: {row['ms']:.0f} ms, {row['samples_per_ray']:.1f} samples a ray, {row['map_MiB']:.1f} MiB; {than}"
        )


if __name__ == "__main__":
    main()
