"""One step of ``bid`` with and without the occupancy grid, and a profile of its time.

    python benchmarks/bid_step.py MAP DATA --name bid_step_lego

Both variants render the same 2048 rays of a test frame from the same pose, 0.1 m from the truth, with the gradient with
respect to the pose; without the grid, every step of the same length inside the scene's box is queried. The variants alternate,
and medians are reported.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.fields.contract import RadianceField, SceneBounds
from bidnerf_core.fields.rendering import render
from bidnerf_core.frames.frame import View
from bidnerf_core.frames.pixels import draw, uniform
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization import BidConfig
from bidnerf_core.localization.method_settings import objective_of
from bidnerf_core.maps.storage import load_map

RESULTS = Path(__file__).parent / "results"

SETTINGS = BidConfig()
RAYS, OBJECTIVE = SETTINGS.descent.rays, objective_of(SETTINGS.colour, SETTINGS.depth)
KINDS = {
    "gathers": ("index_select", "gather", "index", "take", "nonzero", "masked"),
    "matrix products": ("mm", "addmm", "bmm", "linear"),
}


@dataclass(frozen=True, eq=False)
class Query:
    """The input of one step."""

    view: View  # in the frame of its own camera
    start: SE3  # T_world_camera
    bounds: SceneBounds


def step(query: Query, field: RadianceField, seed: int) -> tuple[float, int]:
    """Compute the loss and its gradient with respect to the pose; return the loss and the number of queried samples."""
    pixels = draw([query.view], RAYS, uniform, torch.Generator().manual_seed(seed))
    delta = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    rendering = render(field, pixels.rays(query.start.retract(delta), query.bounds), query.bounds.background)
    loss = OBJECTIVE.loss(rendering, pixels)
    loss.backward()
    return float(loss.detach()), int(rendering.samples.valid.sum())


def shares(query: Query, field: RadianceField) -> dict[str, float]:
    """Return the share of time spent in operators of each kind; ``overhead`` is time outside of any operator."""
    with profile(activities=[ProfilerActivity.CPU]) as trace:
        began = time.perf_counter()
        for seed in range(5):
            step(query, field, seed)
        wall = (time.perf_counter() - began) * 1e6
    spent: Counter[str] = Counter()
    for event in trace.key_averages():
        name = event.key.removeprefix("aten::").rstrip("_")
        kind = next((k for k, names in KINDS.items() if name in names), "elementwise and copies")
        spent[kind] += event.self_cpu_time_total
    result = {kind: value / wall for kind, value in spent.items()}
    return {**result, "overhead": 1 - sum(result.values())}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--name", required=True)
    parser.add_argument("--repeats", type=int, default=7)
    given = parser.parse_args()
    torch.set_num_threads(1)
    with_grid, without = load_map(given.map), load_map(given.map)
    dataset = open_dataset(given.data, with_grid.bounds.background)
    (view,) = dataset.views("test", [dataset.frame_names("test")[0]])
    start = perturb(view.T_ref_camera, 0.1, 2.0, seed=0)
    query = Query(View(view.frame, SE3.identity()), start, with_grid.bounds)
    for sampler in (without.field.sampler, without.field.coarse_sampler):
        sampler.occupied.fill_(True)
        sampler.near_occupied.fill_(True)
    results: dict[str, Any] = {"rays": RAYS}
    for name, level in (("fine", 1), ("coarse", 0)):
        results[name] = compare(
            query, with_grid.field.levels[level], without.field.levels[level], given.repeats
        )
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))
    print(results)


def compare(query: Query, sparse: RadianceField, dense: RadianceField, repeats: int) -> dict[str, Any]:
    """Return the times of both, measured alternately, their losses on the same pixels, and the sparse one's profile."""
    times: dict[str, list[float]] = {"sparse": [], "dense": []}
    losses: dict[str, list[float]] = {"sparse": [], "dense": []}
    samples = {}
    for seed in range(repeats + 1):
        for name, field in (("sparse", sparse), ("dense", dense)):
            began = time.perf_counter()
            loss, samples[name] = step(query, field, seed)
            if seed:  # the first round is a warm-up
                times[name].append(time.perf_counter() - began)
                losses[name].append(loss)
    seconds = {name: statistics.median(values) for name, values in times.items()}
    return {
        "ms_with_grid": 1000 * seconds["sparse"],
        "ms_without": 1000 * seconds["dense"],
        "times_faster": statistics.median(
            d / s for d, s in zip(times["dense"], times["sparse"], strict=True)
        ),
        "samples_per_ray_with_grid": samples["sparse"] / RAYS,
        "samples_per_ray_without": samples["dense"] / RAYS,
        "loss_with_grid": statistics.fmean(losses["sparse"]),
        "loss_without": statistics.fmean(losses["dense"]),
        "loss_spread_between_draws": statistics.stdev(losses["sparse"]),
        "rays_per_second": RAYS / seconds["sparse"],
        "samples_per_second": samples["sparse"] / seconds["sparse"],
        "share_of_time_with_grid": shares(query, sparse),
    }


if __name__ == "__main__":
    main()
