"""The cost of a training step, its profile, and its distance from what the machine can do.

    python benchmarks/training_step.py DATA MAP... --name training_step

Each map's training continues from the trained field, with its own backend and settings, for ``--steps`` steps on all threads
and the same number on one: wall time, CPU time and their ratio, the number of busy cores. A few steps on one thread are
profiled: the share of gathers and scatters (reading from and adding to tables), of matrix products, of the optimizer, of
sorting, and of all other operators, which are elementwise. For comparison, a lower bound of the time for the same work in the
same process is given: the step's matrix products at the rate of a large one, and reading the corners of the hash encoding,
twice (forward, backward), at the rate of a random gather from a table of that size.
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.frames.frame import View
from bidnerf_core.maps.storage import Map, load_map
from bidnerf_core.registry import load_backend
from bidnerf_core.training import Silent, Supervision, TrainingState
from bidnerf_core.training.loop import BESIDE

RESULTS = Path(__file__).parent / "results"
PROFILED = 8
KINDS = {
    "gathers and scatters": ("index_select", "scatter", "gather", "index_put", "index_add", "aten::index"),
    "matrix products": ("aten::mm", "addmm", "matmul"),
    "optimizer": ("_fused_adam",),
    "sorting and searching": ("sort", "searchsorted", "cumsum"),
}
"""Kinds of operators, by a part of their name; the first that matches counts."""


@dataclass
class Timed(Silent):
    """A report that resumes from a state and times each step."""

    state: TrainingState
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    samples_per_ray: list[float] = field(default_factory=list)
    observer: Any = nullcontext()  # entered after the first step, so that it sees no images being loaded
    entered: bool = False

    def resume(self) -> TrainingState:
        self.wall, self.cpu = [time.perf_counter()], [time.process_time()]
        return self.state

    def step(self, progress: Any) -> None:
        self.wall.append(time.perf_counter())
        self.cpu.append(time.process_time())
        self.samples_per_ray.append(progress.samples_per_ray)
        if not self.entered:
            self.entered = True
            self.observer.__enter__()


@dataclass(frozen=True, eq=False)
class Training:
    """A finished training that can be continued for some steps."""

    stored: Map
    views: list[View]
    config: Any

    def state(self) -> TrainingState:
        moments = {"generator": torch.Generator().manual_seed(0).get_state()}
        beside = Supervision(self.views, self.stored.bounds, self.config).colours
        if beside is not None:
            moments |= {BESIDE + name: value for name, value in beside.state_dict().items()}
        own = {name: value.clone() for name, value in self.stored.field.state_dict().items()}  # type: ignore[attr-defined]
        return TrainingState(self.config.steps, own, moments)

    def run(self, steps: int, observer: Any = None) -> Timed:
        """Continue the training. The learning rate is at its minimum by then, so that the field hardly changes.

        ``observer`` is a context in which all steps but the first run.
        """
        report = Timed(self.state(), observer=observer or nullcontext())
        config = replace(self.config, steps=self.config.steps + steps)
        load_backend(self.stored.info.backend).train(self.stored.field, self.views, config, report)
        report.observer.__exit__(None, None, None)
        return report


def reopened(data: Path, folder: Path) -> Training:
    stored = load_map(folder)
    stored.field.requires_grad_(True)  # type: ignore[attr-defined]
    dataset = open_dataset(data, stored.bounds.background)
    config = load_backend(stored.info.backend).config_type
    settings = dict(vars(stored.field.config))  # type: ignore[attr-defined]
    return Training(stored, dataset.views("train"), config(**settings))


def cost(training: Training, steps: int, threads: int) -> dict[str, float]:
    """Return medians over the steps, the first of which is a warm-up."""
    torch.set_num_threads(threads)
    report = training.run(steps + 1)
    wall, cpu = ([b - a for a, b in pairwise(times[1:])] for times in (report.wall, report.cpu))
    return {
        "wall_ms_median": 1e3 * statistics.median(wall),
        "wall_ms_mean": 1e3 * statistics.fmean(wall),
        "cpu_ms_mean": 1e3 * statistics.fmean(cpu),
        "busy_cores": sum(cpu) / sum(wall),
        "samples_per_ray": report.samples_per_ray[-1],
    }


def shares(training: Training) -> dict[str, float]:
    """Return the share of each kind of operator in the CPU time of one thread."""
    torch.set_num_threads(1)
    profiled = profile(activities=[ProfilerActivity.CPU])
    training.run(PROFILED + 1, profiled)
    spent = dict.fromkeys((*KINDS, "elementwise and other"), 0.0)
    for operator in profiled.key_averages():
        fits = (kind for kind, parts in KINDS.items() if any(p in operator.key for p in parts))
        spent[next(fits, "elementwise and other")] += operator.self_cpu_time_total
    return {kind: value / sum(spent.values()) for kind, value in spent.items()}


def least(training: Training) -> dict[str, float]:
    """Return a lower bound of a step's milliseconds on one thread, from matrix products and gathers of the hash encoding."""
    torch.set_num_threads(1)
    counter = FlopCounterMode(display=False)
    training.run(PROFILED + 1, counter)
    operations = counter.get_total_flops() / PROFILED
    found = {"matrix_products": 1e3 * operations / _operations_a_second()}
    encoding = getattr(training.config, "encoding", None)
    if encoding is not None:
        corners = training.config.samples_per_step * encoding.levels * 8
        found["gathers"] = 1e3 * 2 * corners * _seconds_a_gather(2**encoding.log2_table_size)
    return found | {"matrix_operations_giga": operations / 1e9}


def _operations_a_second(side: int = 1024) -> float:
    matrix = torch.rand(side, side)
    return 2 * side**3 / min(_seconds(lambda: matrix @ matrix) for _ in range(5))


def _seconds_a_gather(entries: int, count: int = 2**20) -> float:
    table = torch.rand(entries, dtype=torch.complex64)
    index = torch.randint(entries, (count,), dtype=torch.int32)
    return min(_seconds(lambda: table.index_select(0, index)) for _ in range(5)) / count


def _seconds(work: Any) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("map", type=Path, nargs="+")
    parser.add_argument("--name", required=True, help="of the record")
    parser.add_argument("--steps", type=int, default=33)
    given = parser.parse_args()
    threads = os.cpu_count() or 1
    results = {}
    for folder in given.map:
        training = reopened(given.data, folder)
        results[folder.name] = {
            "backend": training.stored.info.backend,
            "samples_per_step": training.config.samples_per_step,
            f"{threads} threads": cost(training, given.steps, threads),
            "1 thread": cost(training, given.steps, 1),
            "shares of CPU time, 1 thread": shares(training),
            "least milliseconds, 1 thread": least(training),
        }
        print(folder.name, results[folder.name])
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))


if __name__ == "__main__":
    main()
