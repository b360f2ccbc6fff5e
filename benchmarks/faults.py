r"""Accuracy of localization, and of its own judgement, on images with faults.

    python benchmarks/faults.py MAP:DATA [MAP:DATA ...] [--faults FAULT ...] [--foreign DATA ...] [--frames 20] [--rgb | --rgbd]

Each fault is applied to test frames, which method ``auto`` localizes without a start. ``docs/faults.md`` lists the faults; they
are given as for ``bidnerf evaluate --fault``, and by default all are tried at the sizes of the catalogue. ``--foreign`` takes
queries from other datasets: no answer to them is right. Frames whose index in the test split is 1 modulo 5 are for tuning and
left out; ``--tuning-frames`` takes only those.

Every answer is kept as a row of ``NAME.rows.jsonl`` next to the record, with all its numbers and the errors, so that an
interrupted run resumes where it stopped and other programs can use the rows. A row is identified by the content of its map,
its query and the settings, not by the program's version: to measure a change of the program, remove the file or choose another
``--name``. Results: how many of n answers are right (within 5 degrees and 0.05 units), strictly right (1 degree, 0.02),
converged, silent (converged and wrong), and right but rejected; how many of the converged lie inside the 95 % bound of their
covariance; and the median CPU time.
"""

from __future__ import annotations

import argparse
import json
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import asdict, dataclass
from functools import lru_cache
from math import isfinite
from pathlib import Path
from typing import Any

from _lab import (
    RESULTS,
    STRICT,
    Row,
    RowStore,
    cpu_seconds,
    held_out,
    judgement,
    line,
    one_thread,
    parser,
    record,
    within,
    without_depth,
)
from _lab import answer as timed_answer

from bidnerf import Localization, Localizer, Map, load_map
from bidnerf.evaluation import (
    FAULTS,
    NO_FAULT,
    expand_faults,
    faulty,
    local_processes,
    parse_faults,
    parse_settings,
    views_digest,
)
from bidnerf.results import success_rate
from bidnerf_core.datasets import Capture, open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.io import to_plain

FOREIGN = "another-scene"


@dataclass(frozen=True)
class Query:
    """One image to localize: a frame of a dataset with a fault."""

    map: str
    data: str  # folder of the frame's dataset
    frame: str
    depth: bool
    fault: str
    foreign: bool
    config: str  # JSON of the settings that differ from the defaults
    seed: int = 0

    @property
    def cell(self) -> tuple[str, str, str]:
        """The scene, RGB or RGB-D, and the fault, by which answers are counted."""
        fault = f"{FOREIGN}:{Path(self.data).name}" if self.foreign else self.fault
        return Path(self.map).name, "RGB-D" if self.depth else "RGB", fault

    def view(self) -> View:
        """Return the faulty image with its true pose, which for an image of another scene is a pose in that scene."""
        dataset = dataset_of(self.data, map_of(self.map).bounds.background)
        view = faulty(dataset.views("test", [self.frame])[0], self.fault, self.seed)
        return view if self.depth else without_depth(view)

    def key(self) -> list[Any]:
        """Return everything that the answer depends on, by content."""
        info = map_of(self.map).info
        baked = [info.weights, str(info.landmarks), str(info.surface)]
        return [*self.cell, self.frame, self.seed, self.config, *baked, views_digest([self.view()])]


@lru_cache(maxsize=2)
def map_of(folder: str) -> Map:
    """Return a map, cached while its cells are measured."""
    return load_map(Path(folder))


@lru_cache(maxsize=8)
def dataset_of(folder: str, background: tuple[float, float, float]) -> Capture:
    """Return a dataset, cached."""
    return open_dataset(Path(folder), background)


@lru_cache(maxsize=2)
def localizer_of(map: str, config: str) -> Localizer:
    """Return the localizer of a map, cached while its cells are measured."""
    return Localizer(map_of(map), "auto", parse_settings("auto", config))


def answer(query: Query) -> Row:
    """Localize one image; return the whole answer, and its errors where there is a true pose."""
    one_thread()
    localizer, view = localizer_of(query.map, query.config), query.view()
    answers: list[Localization] = []

    def localize() -> Localization:
        answers.append(localizer(view.frame, seed=query.seed))
        return answers[0]

    judged = timed_answer(localize, None if query.foreign else view)
    scene, mode, fault = query.cell
    row = {"scene": scene, "mode": mode, "fault": fault, "frame": query.frame}
    return row | answers[0].plain() | diagnostics_of(answers[0]) | judged


def diagnostics_of(found: Localization) -> dict[str, Any]:
    """Return the diagnostics of an answer, where it has any; those that are unknown are left out."""
    if found.diagnostics is None:
        return {}
    numbers = asdict(found.diagnostics)
    numbers |= numbers.pop("measures", {})
    known = {name: value for name, value in numbers.items() if not isinstance(value, float) or isfinite(value)}
    return {"diagnostics": to_plain(known)}


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the counts of one cell."""
    counts = {
        "n": len(rows),
        "right": sum(map(within, rows)),
        "strict": sum(within(row, STRICT) for row in rows),
    }
    return counts | judgement(rows) | {"median_cpu_seconds": cpu_seconds(rows)["median_cpu_seconds"]}


def queries(given: argparse.Namespace) -> Iterator[Query]:
    """Yield all queries, cell by cell."""
    for pair in given.scenes:
        map, data = pair.split(":", 1)
        for depth in given.modes:
            for fault in given.faults:
                for_depth = any(FAULTS.load(part.name).needs_depth for part in parse_faults(fault))
                if depth or not for_depth:
                    yield from frames_of(given, map, data, depth, fault, False)
            for other in given.foreign:
                if Path(other).resolve() != Path(data).resolve():
                    yield from frames_of(given, map, other, depth, NO_FAULT, True)


def frames_of(
    given: argparse.Namespace, map: str, data: str, depth: bool, fault: str, foreign: bool
) -> Iterator[Query]:
    """Yield the queries of one cell: evenly spaced frames for tuning or for reports; none if depth is needed but missing."""
    dataset = dataset_of(data, map_of(map).bounds.background)
    names = held_out(dataset.frame_names("test"), given.tuning_frames, given.frames)
    if depth and not any(view.frame.has_depth for view in dataset.views("test", names[:1])):
        return
    for name in names:
        yield Query(map, data, name, depth, fault, foreign, given.config, given.seed)


def answer_all(
    asked: Iterator[Query], store: RowStore, executor: Executor, jobs: int
) -> Iterator[tuple[Query, dict[str, Any]]]:
    """Yield all queries with their rows, in order, with ``jobs`` queries under way at a time."""
    waiting: deque[tuple[Query, list[Any], Future[dict[str, Any]] | None]] = deque()

    def first() -> tuple[Query, dict[str, Any]]:
        query, key, future = waiting.popleft()
        return query, store.get(key, lambda: future.result() if future else answer(query))

    for query in asked:
        key = query.key()
        waiting.append((query, key, None if key in store else executor.submit(answer, query)))
        if len(waiting) >= jobs:
            yield first()
    while waiting:
        yield first()


def measure(given: argparse.Namespace, store: RowStore, executor: Executor) -> dict[str, Any]:
    """Return the summaries of all cells by scene and mode, and print each when it is complete."""
    cells: dict[tuple[str, str, str], list[Row]] = {}
    last: tuple[str, str, str] | None = None
    for query, row in answer_all(queries(given), store, executor, given.jobs):
        if last is not None and query.cell != last:
            print(line(" ".join(last), cells[last]), flush=True)
        last = query.cell
        cells.setdefault(last, []).append(row)
    if last is None:
        raise InputError("no query, expected frames with what the faults change")
    print(line(" ".join(last), cells[last]))
    results: dict[str, Any] = {}
    for (scene, mode, fault), rows in cells.items():
        results.setdefault(scene, {}).setdefault(mode, {})[fault] = summary(rows)
    rows = [row for some in cells.values() for row in some]
    print(line("all", rows))
    silent = success_rate(judgement(rows)["silent"], len(rows))
    return {"cells": results, "all": summary(rows) | {"silent_rate": asdict(silent)}}


def arguments() -> argparse.Namespace:
    found = parser(__doc__, "faults", scenes=True)
    found.add_argument("--faults", nargs="*", metavar="FAULT", help="NAME:SIZE,SIZE... or none (default: all)")
    found.add_argument(
        "--foreign", nargs="*", default=[], metavar="DATA", help="datasets of other scenes to query with"
    )
    mode = found.add_mutually_exclusive_group()
    mode.add_argument("--rgb", dest="modes", action="store_const", const=(False,), help="only without measured depth")
    mode.add_argument("--rgbd", dest="modes", action="store_const", const=(True,), help="only with measured depth")
    found.add_argument("--config", default="{}", help="JSON of settings of auto that differ from its defaults")
    found.add_argument("--seed", type=int, default=0)
    found.add_argument("--jobs", type=int, default=1, help="number of processes, of one thread each")
    found.set_defaults(modes=(False, True))
    given = found.parse_args()
    usual = [NO_FAULT, *(f"{name}:{size:g}" for name, fault in FAULTS.items() for size in fault.sizes)]
    given.faults = expand_faults(usual if given.faults is None else given.faults)
    given.config = json.dumps(json.loads(given.config), sort_keys=True)
    return given


def main() -> None:
    given = arguments()
    one_thread()
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store, local_processes(given.jobs) as executor:
        results = measure(given, store, executor)
    record(given.name, results, given.seed)


if __name__ == "__main__":
    main()
