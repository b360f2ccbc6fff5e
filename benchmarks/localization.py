"""Success of a method on a map from seeded starts, on frames that training never saw.

    python benchmarks/localization.py MAP DATA --start bid:0.5 --trials 40 --name localization_lego_bid_0.5

``--start`` is a protocol, with a size where it has sizes: ``bid:SIZE``, ``perturb:METRES:DEGREES``, ``inerf``. Frames whose place in the test split is 1 modulo 5 are left out by default: settings were
tuned on them. Trials run in processes of one thread; finished ones are kept in a ``.jsonl`` beside the record, so that
an interrupted run goes on where it stopped. ``bidnerf evaluate`` is the same for other purposes.
"""

from __future__ import annotations

import argparse
import json
import statistics
from dataclasses import asdict
from pathlib import Path
from typing import Any

from record import RESULTS, write_record

from bidnerf_core.evaluation.bench import Plan, left_to_do, local_processes, planned, run_trials
from bidnerf_core.evaluation.errors import CRITERIA, steps_to_success, success_rate
from bidnerf_core.evaluation.results import ResultsFile, key_of
from bidnerf_core.evaluation.trials import Trial, TrialResult, opened
from bidnerf_core.plain import to_plain


def summary(rows: list[TrialResult]) -> dict[str, Any]:
    """Rates by each criterion with Wilson intervals, steps, time, and how honest ``converged`` was."""
    traces = [row.errors.as_error() for row in rows]
    result: dict[str, Any] = {"trials": len(rows)}
    for name, criterion in CRITERIA.items():
        good = [bool(criterion(trace[-1], trace[0])) for trace in traces]
        result[name] = asdict(success_rate(sum(good), len(rows)))
        reached = [s for trace in traces if (s := steps_to_success(trace, criterion)) is not None]
        result[name]["median_steps_to_success"] = statistics.median(reached) if reached else None
    right = [bool(CRITERIA["5deg 0.05"](trace[-1], trace[0])) for trace in traces]
    said = [row.converged for row in rows]
    result["converged_but_wrong"] = sum(s and not r for s, r in zip(said, right, strict=True))
    result["right_but_not_converged"] = sum(r and not s for s, r in zip(said, right, strict=True))
    result["median_translation"] = statistics.median(float(t.translation[-1]) for t in traces)
    result["median_rotation_deg"] = statistics.median(float(t.rotation_deg[-1]) for t in traces)
    result["median_start_rotation_deg"] = statistics.median(float(t.rotation_deg[0]) for t in traces)
    result["seconds_per_step"] = statistics.median(row.seconds / max(1, row.steps) for row in rows)
    result["peak_resident_GiB"] = max(row.peak_memory_bytes for row in rows) / 2**30
    return result


def final(row: TrialResult) -> dict[str, Any]:
    """A trial without its trace."""
    error = None if row.error is None else to_plain(row.error)
    kept = ("frame", "seed", "converged", "steps", "seconds", "loss")
    return {name: getattr(row, name) for name in kept} | (error or {"translation": None})


def trials(given: argparse.Namespace) -> list[Trial]:
    protocol, *size = given.start.split(":")
    _, dataset = opened(str(given.map), str(given.data))
    names = dataset.frame_names("test")
    kept = [name for place, name in enumerate(names) if given.all_frames or place % 5 != 1]
    return planned(
        Plan(
            str(given.map), str(given.data), protocol, (tuple(map(float, size)),), given.method,
            json.dumps(json.loads(given.config), sort_keys=True), given.trials, given.seed, frames=tuple(kept),
        )
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--start", required=True)
    parser.add_argument("--name", required=True, help="of the record")
    parser.add_argument("--method", default="bid")
    parser.add_argument(
        "--config", default="{}", help="JSON of the method's settings that differ from the defaults"
    )
    parser.add_argument("--trials", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--all-frames", action="store_true", help="also those that settings were tuned on")
    given = parser.parse_args()
    wanted, partial = trials(given), RESULTS / f"{given.name}.partial.jsonl"
    with ResultsFile(partial) as file, local_processes(given.workers) as pool:
        left = len(left_to_do(wanted, file))
        run_trials(wanted, file, pool, given.workers, lambda row: print(".", end="", flush=True))
        print(f" {left} trials done")
        rows = [file.results[key_of(trial)] for trial in wanted]
    results = {"map": given.map.name, "data": given.data.name, "start": given.start, "method": given.method}
    record = {
        **results,
        "settings": rows[0].settings,
        "summary": summary(rows),
        "rows": [final(row) for row in rows],
    }
    print(write_record(given.name, record, given.seed))
    print(json.dumps(summary(rows), indent=1))
    partial.unlink()


if __name__ == "__main__":
    main()
