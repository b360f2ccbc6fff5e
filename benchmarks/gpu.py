"""Performance on a GPU: time and profile of a step by backend, localization without a start, the paper's tables.

    python benchmarks/gpu.py DATA --map MAP [--map MAP ...] --out FOLDER [--part training steps no_start tables]

- ``training``: ``map_quality.py`` on the device, for each backend that ``--train`` names: time, quality, memory;
- ``steps``: milliseconds of a step of ``bid`` with 2048 rays at each level of each map, timed with device events after a
  warm-up: launched one operation at a time, under PyTorch's check that the host never waits, and as a CUDA graph, as in
  ``bid``; with the number of operations and those that take most of the time;
- ``no_start``: method ``auto`` on RGB-D and on RGB test frames: median time and success;
- ``tables``: ``paper_tables.py`` with preset ``paper`` and with ``paper-scene``, on the device.

Finished rows are kept in FOLDER and survive a kill at any moment: the same command resumes where it stopped. When everything is
done, the record ``gpu.json`` is written there. Without a GPU the script prints a message and ends with status 0.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import _lab
import torch
from paper_tables import test_frames

from bidnerf_core import Localizer
from bidnerf_core.devices import captured, without_waiting
from bidnerf_core.evaluation import RowStore, opened, perturb
from bidnerf_core.fields import levels
from bidnerf_core.localization import (
    METHODS,
    AdamSettings,
    AdamSteps,
    DescentSettings,
    ReachSettings,
    SampledLoss,
    objective_of,
    pivot,
    rig,
)

TIMED_RAYS, WARM_UP, TIMED, PROFILED = 2048, 30, 200, 20
FRAMES = 40
"""Maximum number of frames that are localized without a start."""


def made_steps(
    folder: str, data: str, level: int, device: torch.device, rays: int = TIMED_RAYS,
    generator: torch.Generator | None = None,
) -> AdamSteps:  # fmt: skip
    """Return the steps of ``bid`` that start 0.1 units from the first test frame's pose."""
    stored, dataset = opened(folder, data)
    there = None if device.type == "cpu" else device
    scene = Localizer(stored, "bid", device=there, warm_up=False).scene
    view = dataset.views("test", test_frames(folder, data, tuning=False)[:1])[0]
    problem = rig(scene, [view], perturb(view.T_ref_camera, 0.1, 2.0, seed=0))
    usual = METHODS["bid"].settings("paper-scene")
    loss = SampledLoss(
        problem.on_device(), objective_of(usual.colour, usual.depth), 0,
        DescentSettings(rays=rays, level=level), ReachSettings(), generator or torch.Generator(device).manual_seed(0),
    )  # fmt: skip
    # Poses hardly move, so that all steps render the same.
    rate = AdamSettings(learning_rate=1e-9, decay=1.0)
    return AdamSteps(loss, pivot("scene", problem), rate, problem.start_for("bid").to(device))


def timed(step: Callable[[], None], count: int) -> tuple[float, float]:
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
            launched = timed(steps, TIMED)
        finally:
            torch.cuda.set_sync_debug_mode("default")
        found = operations(steps)
        began = time.perf_counter()
        replay = captured(steps, device, generator)
        capturing = time.perf_counter() - began
        timed(replay, WARM_UP)
        graph = timed(replay, TIMED)
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
    for level in range(len(levels(opened(folder, data, str(device))[0].field))):
        generator = torch.Generator(device).manual_seed(0)
        steps = made_steps(folder, data, level, device, generator=generator)
        found[f"level {level}"] = timed_steps(steps, device, generator)
    return found


def trained(backend: str, data: str, out: Path, device: torch.device) -> dict[str, Any]:
    """Train a map with the defaults of a backend, and return its quality and the cost of training."""
    script, name = Path(__file__).with_name("map_quality.py"), f"map_gpu_{backend}"
    subprocess.run(
        [sys.executable, str(script), data, "--out", str(out / f"{backend}_map"), "--name", name,
         "--results", str(out), "--device", str(device), "--", "--backend", backend, "--device", str(device)],
        check=True,
    )  # fmt: skip
    record = json.loads((out / f"{name}.json").read_text())
    return {"record": name, "training": record["results"]["training"], "levels": record["results"]["levels"]}


def no_start_rows(folder: str, data: str, device: torch.device) -> dict[str, Any]:
    """Return the median time (ms) and the success of ``auto`` on frames with and without depth."""
    stored, dataset = opened(folder, data, str(device))
    views = dataset.views("test", test_frames(folder, data, tuning=False)[:FRAMES])
    localizer, found = Localizer(stored), {}
    for name, shown in _lab.modes(views).items():
        localizer(shown[0].frame)  # warm-up
        rows, times = [], []
        for view in shown:
            began = time.perf_counter()
            rows.append(_lab.answer(partial(localizer, view.frame), view))
            times.append(1000 * (time.perf_counter() - began))
        right = sum(map(_lab.within, rows))
        found[name] = {"ms": statistics.median(times), "within 5 degrees, 0.05": right, "frames": len(views)}
    return found


def table_rows(
    folder: str, data: str, out: Path, preset: str, device: torch.device, workers: int
) -> dict[str, Any]:
    """Run the paper's tables in a process of their own, which resumes where it stopped."""
    script = Path(__file__).with_name("paper_tables.py")
    began, tables = time.perf_counter(), out / preset
    subprocess.run(
        [sys.executable, str(script), data, "--map", folder, "--out", str(tables), "--preset", preset,
         "--device", str(device), "--workers", str(workers)],
        check=True,
    )  # fmt: skip
    return {"folder": tables.name, "seconds": time.perf_counter() - began}


def attempted(what: str, make: Callable[[], Any]) -> Any:
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
    parts = ("training", "steps", "no_start", "tables")
    parser.add_argument("--part", nargs="+", choices=parts, default=list(parts))
    parser.add_argument(
        "--train", nargs="*", default=[], help="backends to train on DATA with their defaults"
    )
    parser.add_argument(
        "--workers", type=int, default=4, help="processes that share the device for the tables"
    )
    given = parser.parse_args()
    if not torch.cuda.is_available():
        print("no GPU here: nothing was measured, and no record was written")
        return
    device, gpu = torch.device("cuda"), torch.cuda.get_device_name()
    given.out.mkdir(parents=True, exist_ok=True)
    results: dict[str, Any] = {"gpu": gpu, "rays": TIMED_RAYS}
    with RowStore(given.out / "gpu.rows.jsonl") as store:
        for backend in given.train if "training" in given.part else []:
            make = partial(trained, backend, given.data, given.out, device)
            results.setdefault("training", {})[backend] = store.get(
                [gpu, backend, "training"], partial(attempted, f"{backend}: training", make)
            )
        for folder in given.map:
            name = Path(folder).name
            rows: dict[str, Callable[[], Any]] = {
                "steps": partial(step_rows, folder, given.data, device),
                "no_start": partial(no_start_rows, folder, given.data, device),
            } | {
                f"tables {preset}": partial(
                    table_rows, folder, given.data, given.out, preset, device, given.workers
                )
                for preset in ("paper", "paper-scene")
            }
            for row, make in rows.items():
                if row.partition(" ")[0] in given.part:
                    key = [gpu, name, row]
                    results.setdefault(row, {})[name] = store.get(
                        key, partial(attempted, f"{name}: {row}", make)
                    )
    _lab.record("gpu", results, folder=given.out)


if __name__ == "__main__":
    main()
