"""Success and speed of methods on maps, from the same seeded starts, on frames that training never saw.

    python benchmarks/localization.py MAP DATA --start bid:0.5 --trials 40 --method bid --name localization_lego_bid_0.5
    python benchmarks/localization.py MAP DATA --start none --name no_start_lego
    python benchmarks/localization.py MAP DATA --start bid:0.5 --trials 20 --method bid bid-lm auto --name speed_lego

``--start`` is a protocol, with a size where it has sizes: ``bid:SIZE``, ``perturb:METRES:DEGREES``, ``inerf``, ``none``; one
record may hold several. Without ``--trials`` each frame is tried once. All methods take turns on each start, and are compared
with the first one. Trials run in processes of one thread, one by default, so that times can be compared. Finished trials are
kept in a ``.jsonl`` next to the record, so that an interrupted run resumes where it stopped. For other purposes, use
``bidnerf evaluate``.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from _lab import BOUND, RESULTS, held_out, parser, record

from bidnerf import SE3
from bidnerf.evaluation import (
    Plan,
    ResultsFile,
    Summary,
    Trial,
    TrialResult,
    median,
    opened,
    planned,
    run_trials,
    summarize,
)
from bidnerf.results import normalized_error_squared, success_rate
from bidnerf_core.progress import job_context

Truth = dict[str, SE3]
"""T_world_camera of each frame, by its name."""


def summary(rows: list[TrialResult], truth: Truth) -> dict[str, Any]:
    """Return the usual statistics of trials, and how many errors lie inside the 95 % bounds of their covariances."""
    result = asdict(summarize(rows))
    normalized = [value for row in rows if (value := nees(row, truth)) is not None]
    if normalized:
        inside = sum(value <= BOUND for value in normalized)
        result["consistent"] = asdict(success_rate(inside, len(normalized)))
        result["median_normalized_error_squared"] = median(normalized)
    starts = [row.start_error for row in rows]
    result["median_start_rotation_deg"] = median(e.rotation_deg if e else None for e in starts)
    result["slowest_seconds"] = max(row.seconds for row in rows)
    result["settings"] = rows[0].settings
    return result


def nees(row: TrialResult, truth: Truth) -> float | None:
    """Return the normalised (estimation) error squared: infinite for a singular covariance, None without one."""
    if row.covariance is None or row.T_world_camera is None:
        return None
    found = SE3.from_matrix(torch.tensor(row.T_world_camera, dtype=torch.float64))
    spread = torch.tensor(row.covariance, dtype=torch.float64)
    value = float(normalized_error_squared(found, truth[row.frame], spread))
    return value if math.isfinite(value) and value >= 0 else math.inf


def times_less(base: Summary, other: Summary) -> dict[str, float | None]:
    """Return how many times fewer steps and less time ``other`` takes than ``base``: in all, and to success."""
    found: dict[str, float | None] = {
        "steps": base.steps / other.steps,
        "seconds": base.seconds / other.seconds,
    }
    for name, one in base.success.items():
        two = other.success[name]
        if one is not None and two is not None:
            found[f"{name}: steps to success"] = _ratio(one.steps, two.steps)
            found[f"{name}: time to success"] = _ratio(one.milliseconds, two.milliseconds)
    return found


def _ratio(one: float | None, two: float | None) -> float | None:
    return None if one is None or not two else one / two


def trials(given: argparse.Namespace, start: str, method: str) -> list[Trial]:
    """Return the trials of a method from one kind of start."""
    protocol, *size = start.split(":")
    dataset = opened(given.map, given.data)[1]
    names = dataset.frame_names("test")
    kept = names if given.all_frames else held_out(names, given.tuning_frames)
    plan = Plan(
        protocol=protocol,
        sizes=[list(map(float, size))],
        method=method,
        trials=given.trials or len(kept),
        config=json.dumps(json.loads(given.config), sort_keys=True),
        seed=given.seed,
        frames=kept,
        depth=not given.no_depth,
    )
    return planned(plan, given.map, given.data, dataset)


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("map")
    arguments.add_argument("data")
    arguments.add_argument("--start", nargs="+", default=["none"])
    arguments.add_argument("--method", nargs="+", default=["auto"])
    arguments.add_argument(
        "--config", default="{}", help="JSON of settings that differ from the defaults of all methods"
    )
    arguments.add_argument("--trials", type=int, help="from each start")
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--workers", type=int, default=1)
    arguments.add_argument("--tuning-frames", action="store_true", help="only frames that settings are tuned on")
    arguments.add_argument("--all-frames", action="store_true", help="also those that settings were tuned on")
    arguments.add_argument("--no-depth", action="store_true", help="withhold the measured depth")
    given = arguments.parse_args()
    wanted = {(start, method): trials(given, start, method) for start in given.start for method in given.method}
    partial = RESULTS / f"{given.name}.rows.jsonl"
    with ResultsFile(partial) as file, job_context(lambda now: print(".", end="", flush=True)):
        turns = [
            trial
            for start in given.start
            for same in zip(*(wanted[start, m] for m in given.method), strict=True)
            for trial in same
        ]
        run_trials(turns, file, workers=given.workers)
        print()
        rows = {which: [file[trial] for trial in part] for which, part in wanted.items()}
    truth = {view.frame.name: view.T_ref_camera for view in opened(given.map, given.data)[1].views("test")}
    starts: dict[str, Any] = {}
    for start in given.start:
        first, *others = given.method
        base = summarize(rows[start, first])
        starts[start] = {
            "methods": {method: summary(rows[start, method], truth) for method in given.method},
            f"times less than {first}": {m: times_less(base, summarize(rows[start, m])) for m in others},
        }
    results = {
        "map": Path(given.map).name,
        "data": Path(given.data).name,
        "depth": not given.no_depth,
        "starts": starts,
    }
    record(given.name, results, given.seed)
    for start, found in starts.items():
        for method, s in found["methods"].items():
            print(
                start,
                method,
                {name: s[name] for name in ("trials", "converged", "converged_but_wrong", "seconds")},
            )


if __name__ == "__main__":
    main()
