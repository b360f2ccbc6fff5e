"""Performance on a GPU: a step, a search, queries one by one and many at once, training, and the paper's tables.

    python benchmarks/gpu.py DATA --map MAP [--map MAP ...] --out FOLDER [--part kernel steps search queries training tables]

- ``kernel``: the hash grid with its derivatives at 2^19 points, as a share of what its memory accesses and products
  take at the rates that the device reaches in plain gathers and plain products;
- ``steps``: milliseconds of a step of ``bid`` with 2048 rays at each level of each map, timed with device events after a
  warm-up: launched one operation at a time, under PyTorch's check that the host never waits, and as a CUDA graph, as in
  ``bid``; with the number of operations and those that take most of the time;
- ``search``: 5 Gauss-Newton steps of 64 poses with 256 rays each, and of one pose with 2048, as CUDA graphs;
- ``queries``: method ``auto`` without a start on RGB and RGB-D test frames, one by one and 64 with ``Localizer.many``, and
  how the answers compare with the CPU's;
- ``training``: seconds of training until unseen images reach 31 dB;
- ``tables``: ``paper_tables.py`` with preset ``paper-scene``, on the device.

Finished rows are kept in FOLDER and survive a kill at any moment: the same command resumes where it stopped. When everything is
done, the record ``gpu.json`` is written there. Without a GPU the script prints a message and ends with status 0.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import _lab
import torch
from _lab import RowStore
from paper_tables import test_frames

from bidnerf import Localizer, View
from bidnerf.evaluation import open_scene
from bidnerf_bid import AdamSettings, AdamSteps, DescentSettings, ReachSettings, SampledLoss, objective_of, pivot
from bidnerf_core.backend import SceneBounds, load_backend
from bidnerf_core.devices import capture_graph, move_to, without_waiting
from bidnerf_core.fields import RadianceField, derivatives_of, levels, render_image, trained_field
from bidnerf_core.geometry import SE3, perturb
from bidnerf_core.io import from_plain
from bidnerf_core.localization import (
    METHODS,
    ColourSettings,
    DepthLossSettings,
    draw_rays,
    rig,
    states_at,
)
from bidnerf_core.mapping import descend
from bidnerf_core.training import Silent, TrainingStep, TrainingStopped

TIMED_RAYS, WARM_UP, TIMED, PROFILED = 2048, 30, 200, 5
POINTS, SIDE = 2**19, 4096
"""Points at which the field is timed, and the side of the matrices whose product shows what the device can do."""
SEARCH_STEPS = 5
FRAMES, MANY = 16, 64
"""Frames that are localized one by one, twice of which the second time counts, and how many are localized together."""
ENOUGH, EVERY, SAMPLES = 31.0, 0.5, 2**15
"""Quality of unseen images (dB) at which training ends, seconds of training from one check to the next, and samples per
step: twice the default, which is meant for a small CPU, take hardly more time on a GPU."""


def made_steps(
    folder: str,
    data: str,
    level: int,
    device: torch.device,
    rays: int = TIMED_RAYS,
    generator: torch.Generator | None = None,
) -> AdamSteps:
    """Return the steps of ``bid`` that start 0.1 units from the first test frame's pose."""
    stored, dataset = open_scene(folder, data)
    there = None if device.type == "cpu" else device
    scene = Localizer(stored, "bid", device=there, warm_up=False).scene
    view = dataset.views("test", test_frames(folder, data, tuning=False)[:1])[0]
    start = perturb(view.T_ref_camera, 0.1, 2.0, seed=0)
    problem = rig(scene, [view], start)
    usual = METHODS["bid"].settings("paper-scene")
    loss = SampledLoss(
        move_to(problem, device),
        objective_of(usual.colour, usual.depth),
        0,
        DescentSettings(rays=rays, level=level),
        ReachSettings(),
        generator or torch.Generator(device).manual_seed(0),
    )
    # Poses hardly move, so that all steps render the same.
    rate = AdamSettings(learning_rate=1e-9, decay=1.0)
    return AdamSteps(loss, pivot("scene", problem), rate, start.to(device))


def measure_time(step: Callable[[], None], count: int) -> tuple[float, float]:
    """Return the median and the maximum time of a step (ms), measured with device events."""
    torch.cuda.synchronize()
    marks = [torch.cuda.Event(enable_timing=True) for _ in range(count + 1)]
    for mark in marks[:-1]:
        mark.record()
        step()
    marks[-1].record()
    torch.cuda.synchronize()
    times = [a.elapsed_time(b) for a, b in pairwise(marks)]
    return statistics.median(times), max(times)


def timed_steps(steps: AdamSteps, device: torch.device, generator: torch.Generator) -> dict[str, Any]:
    """Return the times of a step, launched and as a graph, and the most expensive operations."""
    with without_waiting():
        for _ in range(WARM_UP):
            steps()
        torch.cuda.synchronize()
        torch.cuda.set_sync_debug_mode("error")  # a step in which the host waits raises
        try:
            launched = measure_time(steps, TIMED)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        found = operations(steps)
        began = time.perf_counter()
        replay = capture_graph(steps, device, generator)
        capturing = time.perf_counter() - began
        measure_time(replay, WARM_UP)
        graph = measure_time(replay, TIMED)
    return {
        "graph_ms": graph[0],
        "graph_ms_most": graph[1],
        "capture_ms": 1000 * capturing,
        "launched_ms": launched[0],
        "launched_ms_most": launched[1],
        "is_graph": replay is not steps,
        **found,
    }


def operations(steps: AdamSteps) -> dict[str, Any]:
    """Return the number of kernels that a step launches, their total time, and the ten longest with their shares of it."""
    kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=kinds, acc_events=True) as profile:
        for _ in range(PROFILED):
            steps()
        torch.cuda.synchronize()
    kernels = [row for row in profile.key_averages() if row.device_type == torch.autograd.DeviceType.CUDA]
    total = sum(row.self_device_time_total for row in kernels) or 1
    most = sorted(kernels, key=lambda row: -row.self_device_time_total)[:10]
    return {
        "kernels": sum(row.count for row in kernels) / PROFILED,
        "kernels_ms": total / 1000 / PROFILED,
        "operations": [
            {"name": row.key, "calls": row.count / PROFILED, "share": row.self_device_time_total / total}
            for row in most
        ],
    }


def step_rows(folder: str, data: str, device: torch.device) -> dict[str, Any]:
    """Return the times of a step at each level of a map."""
    found = {}
    for level in range(len(levels(open_scene(folder, data)[0].field))):
        generator = torch.Generator(device).manual_seed(0)
        steps = made_steps(folder, data, level, device, generator=generator)
        found[f"level {level}"] = timed_steps(steps, device, generator)
    return found


def kernel_row(folder: str, data: str, device: torch.device) -> dict[str, Any]:
    """Return the time of the field with its derivatives at many points, and what its accesses and products take alone."""
    stored = open_scene(folder, data)[0].to(device)
    lower, upper = (torch.tensor(corner, device=device) for corner in (stored.bounds.lower, stored.bounds.upper))
    at = lower + (upper - lower) * torch.rand(POINTS, 3, device=device)
    along = torch.nn.functional.normalize(torch.randn(POINTS, 3, device=device), dim=-1)
    field: Any = trained_field(stored.field)
    own = measure_time(lambda: derivatives_of(stored.field, at, along), 20)[0]
    # An access reads at least a sector of 32 bytes: eight corners of each level. A sixteenth of them fits into memory.
    table = torch.cat(list(field.encoding.tables))
    index = torch.randint(len(table), (len(field.encoding.levels) * POINTS // 2,), device=device)
    reads = 16 * measure_time(lambda: table.index_select(0, index), 20)[0]
    # The values, three derivatives of the density network, and six of the colour network, in the precision of the kernel.
    geometry, colour = (sum(part.numel() for part in net.parameters()) for net in (field.geometry, field.colour))
    matrix = torch.randn(SIDE, SIDE, device=device)
    usual = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high")
    product = measure_time(lambda: matrix @ matrix, 20)[0] / SIDE**3
    torch.set_float32_matmul_precision(usual)
    floors = {"reads": reads, "products": POINTS * (4 * geometry + 7 * colour) * product}
    return {"points": POINTS, "ms": own, "bounds_ms": floors, "share": max(floors.values()) / own}


def search_row(folder: str, data: str, device: torch.device) -> dict[str, Any]:
    """Return the time of Gauss-Newton steps on rendered rays as a CUDA graph, and the memory that they take."""
    stored, dataset = open_scene(folder, data)
    view, found = dataset.views("test", test_frames(folder, data, tuning=False)[:1])[0], {}
    problem = rig(stored.to(device), [view], None)
    pivot_of_scene = torch.tensor([0.0, 0.0, 3.5], dtype=torch.float64, device=device)
    for poses, rays in ((64, 256), (1, TIMED_RAYS)):
        term = draw_rays(problem, ColourSettings(), DepthLossSettings(), rays, 0)
        starts = SE3.stack([perturb(view.T_ref_camera, 0.05, 2.0, seed) for seed in range(poses)])
        states = move_to(states_at(starts), device)
        step = partial(descend, states, [term], SEARCH_STEPS, pivot_of_scene)
        with torch.no_grad(), without_waiting():
            for _ in range(3):
                step()
            torch.cuda.reset_peak_memory_stats()
            replay = capture_graph(step, device)
            milliseconds = measure_time(replay, 50)[0]
        found[f"{poses} poses, {rays} rays"] = {
            "ms": milliseconds,
            "is_graph": replay is not step,
            "memory_bytes": torch.cuda.max_memory_allocated(),
        }
    return found


def query_rows(folder: str, data: str, device: torch.device) -> dict[str, Any]:
    """Return the times of ``auto`` on frames with and without depth, and how the answers compare with the CPU's."""
    stored, dataset = open_scene(folder, data)
    views = dataset.views("test", test_frames(folder, data, tuning=False)[:FRAMES])
    here, there, found = Localizer(stored), Localizer(stored, device=device), {}
    for name, shown in _lab.modes(views).items():
        rows, times = list[_lab.Row](), list[float]()
        for view in (*shown, *shown):
            began = time.perf_counter()
            rows.append(_lab.answer(partial(there, view.frame), view))
            times.append(1000 * (time.perf_counter() - began))
        rows, times = rows[len(shown) :], times[len(shown) :]
        several = {}
        if name == "RGB":
            many = [view.frame for view in (shown * MANY)[:MANY]]
            for _ in range(2):  # the first time, each stream captures its graphs
                began = time.perf_counter()
                list(there.many(many))
                several = {"many_per_second": MANY / (time.perf_counter() - began)}
        expected = [_lab.answer(partial(here, view.frame), view) for view in shown]
        found[name] = {
            "ms": statistics.median(times),
            "ms_most": max(times),
            "frames": len(shown),
            **several,
            "right": sum(map(_lab.within, rows)),
            "right_on_cpu": sum(map(_lab.within, expected)),
            "same_outcomes": sum(a["outcome"] == b["outcome"] for a, b in zip(rows, expected, strict=True)),
        }
    return found


class UntilSharp(Silent):
    """Ends a training once unseen images are rendered well enough; rendering them does not count as training."""

    def __init__(self, field: RadianceField, bounds: SceneBounds, views: Sequence[View]) -> None:
        self._field, self._bounds, self._views = field, bounds, views
        self.began, self.seconds, self.steps, self.reached = time.perf_counter(), 0.0, 0, 0.0
        self.before = 0.0  # seconds before the first steps were done: kernels are compiled, and images sent

    def step(self, progress: TrainingStep) -> None:
        torch.cuda.synchronize()
        trained = self.seconds + time.perf_counter() - self.began
        self.before = self.before or trained
        if trained < EVERY * (self._checks + 1):
            return
        self._checks += 1
        self.seconds, self.steps = trained, progress.step
        self.reached = statistics.mean(map(self._quality, self._views))
        self.stopping = self.reached >= ENOUGH
        torch.cuda.synchronize()
        self.began = time.perf_counter()

    def _quality(self, view: View) -> float:
        found = render_image(self._field, view.frame.intrinsics, view.T_ref_camera, self._bounds)
        return -10 * math.log10(float((found.rgb.cpu() - view.frame.rgb).square().mean()))

    stopping = False
    _checks = 0


def training_row(folder: str, data: str, device: torch.device) -> dict[str, Any]:
    """Return how long a field like the map's takes to train until unseen images reach ``ENOUGH`` decibels."""
    stored, dataset = open_scene(folder, data)
    backend, bounds = load_backend(stored.info.backend), stored.bounds
    config = from_plain(backend.config_type, stored.info.config, "the map's settings")
    train = [view.over(bounds.background) for view in dataset.views("train", dataset.frame_names("train"))]
    unseen = [
        view.over(bounds.background) for view in dataset.views("test", test_frames(folder, data, tuning=False)[:6])
    ]
    config = replace(config, steps=backend.config_type().steps, samples_per_step=SAMPLES)
    field = backend.build(config, bounds).to(device)
    torch.cuda.reset_peak_memory_stats()
    report = UntilSharp(field, bounds, unseen)
    with suppress(TrainingStopped):
        backend.train(field, train, config, report)
    return {
        "psnr": report.reached,
        "samples_per_step": SAMPLES,
        "seconds": report.seconds,
        "seconds_before_first_steps": report.before,
        "steps": report.steps,
        "ms_a_step": 1000 * (report.seconds - report.before) / report.steps,
        "memory_bytes": torch.cuda.max_memory_allocated(),
    }


def table_rows(folder: str, data: str, device: torch.device, out: Path, workers: int) -> dict[str, Any]:
    """Run the paper's tables in a process of their own, which resumes where it stopped."""
    script = Path(__file__).with_name("paper_tables.py")
    began, tables = time.perf_counter(), out / "tables"
    subprocess.run(
        [
            sys.executable,
            str(script),
            data,
            "--map",
            folder,
            "--out",
            str(tables),
            "--preset",
            "paper-scene",
            "--device",
            str(device),
            "--workers",
            str(workers),
        ],
        check=True,
    )
    return {"folder": tables.name, "seconds": time.perf_counter() - began}


def attempt(what: str, make: Callable[[], Any]) -> Any:
    """Return the result of ``make``, or why it failed, so that the other rows are measured nevertheless."""
    print(what, flush=True)
    try:
        return make()
    except (RuntimeError, subprocess.CalledProcessError) as error:
        return {"failed": f"{type(error).__name__}: {str(error).splitlines()[0]}"}


def main() -> None:
    parser = _lab.parser(__doc__, named=False)
    parser.add_argument("data")
    parser.add_argument("--map", action="append", required=True, help="a folder; may be given again")
    parser.add_argument("--out", type=Path, default=_lab.RESULTS)
    rows: dict[str, Callable[..., dict[str, Any]]] = {
        "kernel": kernel_row,
        "steps": step_rows,
        "search": search_row,
        "queries": query_rows,
        "training": training_row,
        "tables": table_rows,
    }
    parser.add_argument("--part", nargs="+", choices=list(rows), default=list(rows))
    parser.add_argument("--name", default="gpu", help="of the record (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=4, help="processes that share the device for the tables")
    given = parser.parse_args()
    if not torch.cuda.is_available():
        print("no GPU here: nothing was measured, and no record was written")
        return
    device, gpu = torch.device("cuda"), torch.cuda.get_device_name()
    given.out.mkdir(parents=True, exist_ok=True)
    rows["tables"] = partial(table_rows, out=given.out, workers=given.workers)
    results: dict[str, Any] = {"gpu": gpu, "rays": TIMED_RAYS}
    with RowStore(given.out / f"{given.name}.rows.jsonl") as store:
        for folder in given.map:
            name = Path(folder).name
            for row in given.part:
                make = partial(rows[row], folder, given.data, device)
                found = store.get([gpu, name, row], partial(attempt, f"{name}: {row}", make))
                print(json.dumps(found), flush=True)
                results.setdefault(row, {})[name] = found
    _lab.record(given.name, results, folder=given.out)


if __name__ == "__main__":
    main()
