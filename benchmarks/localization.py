"""Success of a method on a map from seeded starts, on frames that training never saw.

    python benchmarks/localization.py MAP DATA --start bid:0.5 --trials 40 --name localization_lego_bid_0.5
    python benchmarks/localization.py MAP DATA --start none --method auto --all-frames --name no_start_lego

``--start`` is a protocol, with a size where it has sizes: ``bid:SIZE``, ``perturb:METRES:DEGREES``, ``inerf``, ``none``; one
record may hold several. Frames whose index in the test split is 1 modulo 5 are left out by default, since settings were
tuned on them. Without ``--trials`` each frame is tried once. Trials run in processes of one thread; finished trials are
kept in a ``.jsonl`` next to the record, so that an interrupted run resumes where it stopped. For other purposes, use
``bidnerf evaluate``.

Where a method gives a covariance, ``consistent`` counts the answers whose normalised squared error lies inside the 95 %
bound of chi-squared with 6 degrees of freedom.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from scipy.stats import chi2

from bidnerf_core.evaluation.bench import Plan, left_to_do, planned, run_trials
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.results import ResultsFile, key_of
from bidnerf_core.evaluation.summary import median, summarize
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.evaluation.trials import opened
from bidnerf_core.evaluation.workers import local_processes
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.json import to_plain
from bidnerf_core.results.errors import normalized_error_squared, success_rate

RESULTS = Path(__file__).parent / "results"

BOUND = float(chi2(6).ppf(0.95))


def summary(rows: list[TrialResult], truth: dict[str, SE3]) -> dict[str, Any]:
    """Return the usual statistics of trials, and the consistency of their covariances."""
    result = asdict(summarize(rows))
    normalized = [value for row in rows if (value := nees(row, truth)) is not None]
    if normalized:
        inside = sum(value <= BOUND for value in normalized)
        result["consistent"] = asdict(success_rate(inside, len(normalized)))
        result["median_normalized_error_squared"] = median(normalized)
    starts = [row.start_error for row in rows]
    result["median_start_rotation_deg"] = median(e.rotation_deg if e else None for e in starts)
    result["slowest_seconds"] = max(row.seconds for row in rows)
    return result


def nees(row: TrialResult, truth: dict[str, SE3]) -> float | None:
    """Return the normalised (estimation) error squared: infinite for a singular covariance, None without one."""
    if row.covariance is None or row.T_world_camera is None:
        return None
    found = SE3.from_matrix(torch.tensor(row.T_world_camera, dtype=torch.float64))
    spread = torch.tensor(row.covariance, dtype=torch.float64)
    value = float(normalized_error_squared(found, truth[row.frame], spread))
    return value if math.isfinite(value) and value >= 0 else math.inf


def final(row: TrialResult, truth: dict[str, SE3]) -> dict[str, Any]:
    """Return a trial without its trace."""
    error = None if row.error is None else to_plain(row.error)
    value = nees(row, truth)
    kept = ("frame", "seed", "converged", "reason", "steps", "seconds", "loss")
    return (
        {name: getattr(row, name) for name in kept}
        | (error or {"translation": None})
        | ({} if value is None else {"normalized_error_squared": value if math.isfinite(value) else None})
    )


def trials(given: argparse.Namespace, start: str) -> list[Trial]:
    """Return the trials from one kind of start."""
    protocol, *size = start.split(":")
    _, dataset = opened(str(given.map), str(given.data))
    names = dataset.frame_names("test")
    kept = [name for place, name in enumerate(names) if given.all_frames or place % 5 != 1]
    return planned(
        Plan(
            str(given.map), str(given.data), protocol, (tuple(map(float, size)),), given.method,
            json.dumps(json.loads(given.config), sort_keys=True), given.trials or len(kept), given.seed,
            frames=tuple(kept), depth=not given.no_depth,
        )
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--start", nargs="+", required=True)
    parser.add_argument("--name", required=True, help="of the record")
    parser.add_argument("--method", default="bid")
    parser.add_argument(
        "--config", default="{}", help="JSON of the method's settings that differ from the defaults"
    )
    parser.add_argument("--trials", type=int, help="from each start")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--all-frames", action="store_true", help="also those that settings were tuned on")
    parser.add_argument("--no-depth", action="store_true", help="withhold the measured depth")
    given = parser.parse_args()
    wanted = {start: trials(given, start) for start in given.start}
    partial = RESULTS / f"{given.name}.partial.jsonl"
    with ResultsFile(partial) as file, local_processes(given.workers) as pool:
        every = [trial for part in wanted.values() for trial in part]
        left = len(left_to_do(every, file))
        run_trials(every, file, pool, given.workers, lambda row: print(".", end="", flush=True))
        print(f" {left} trials done")
        rows = {start: [file.results[key_of(trial)] for trial in part] for start, part in wanted.items()}
    _, dataset = opened(str(given.map), str(given.data))
    truth = {view.frame.name: view.T_ref_camera for view in dataset.views("test")}
    record = {
        "map": given.map.name,
        "data": given.data.name,
        "method": given.method,
        "depth": not given.no_depth,
        "settings": rows[given.start[0]][0].settings,
        "starts": {
            start: {"summary": summary(part, truth), "rows": [final(row, truth) for row in part]}
            for start, part in rows.items()
        },
    }
    print(write_record(RESULTS / f"{given.name}.json", record, given.seed))
    print(json.dumps({start: part["summary"] for start, part in record["starts"].items()}, indent=1))
    partial.unlink()


if __name__ == "__main__":
    main()
