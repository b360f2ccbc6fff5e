r"""Methods and maps compared in one run: the same starts, one after the other.

    python benchmarks/localization_speed.py DATA --map MAP [MAP ...] --start bid:0.5 --methods bid bid-lm auto --trials 20 \
        --name speed_lego

``--start`` is a protocol, with a size where it has sizes: ``bid:SIZE``, ``perturb:METRES:DEGREES``, ``inerf``, ``none``.
The first method is the one that the others are compared with, on each map. Frames whose place in the test split is 1
modulo 5 are left out, since settings were tuned on them; ``--tuning-frames`` takes those alone. One process of one thread;
finished trials are kept in a ``.jsonl`` beside the record, so that an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import statistics
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from record import RESULTS, write_record

from bidnerf_core.evaluation.bench import Plan, planned
from bidnerf_core.evaluation.errors import CRITERIA, steps_to_success, success_rate
from bidnerf_core.evaluation.results import ResultsFile, key_of
from bidnerf_core.evaluation.summary import applies
from bidnerf_core.evaluation.trials import Trial, TrialResult, opened, run_trial


def summary(rows: list[TrialResult]) -> dict[str, Any]:
    """Success by each criterion with steps and seconds to it, cost, final errors, and honesty."""
    traces = [row.errors.as_error() for row in rows]
    result: dict[str, Any] = {"trials": len(rows)}
    for name, criterion in CRITERIA.items():
        if not applies(name, rows):
            continue
        steps = [steps_to_success(trace, criterion) for trace in traces]
        good = [(row, s) for row, s in zip(rows, steps, strict=True) if s is not None]
        seconds = [row.seconds * s / max(1, row.steps) for row, s in good]
        result[name] = asdict(success_rate(len(good), len(rows))) | {
            "median_steps_to_success": statistics.median(s for _, s in good) if good else None,
            "median_seconds_to_success": statistics.median(seconds) if good else None,
        }
    right = [bool(CRITERIA["5deg 0.05"](trace[-1], trace[0])) for trace in traces]
    said = [row.converged for row in rows]
    return result | {
        "median_steps": statistics.median(row.steps for row in rows),
        "median_seconds": statistics.median(row.seconds for row in rows),
        "median_translation": statistics.median(float(t.translation[-1]) for t in traces),
        "median_rotation_deg": statistics.median(float(t.rotation_deg[-1]) for t in traces),
        "converged_but_wrong": sum(s and not r for s, r in zip(said, right, strict=True)),
        "right_but_not_converged": sum(r and not s for s, r in zip(said, right, strict=True)),
    }


def ratios(base: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """How many times fewer steps and less time ``other`` takes: in all, and to success."""
    found = {name: base[name] / other[name] for name in ("median_steps", "median_seconds")}
    for criterion in (name for name in CRITERIA if name in base):
        for what in ("median_steps_to_success", "median_seconds_to_success"):
            one, two = base[criterion][what], other[criterion][what]
            found[f"{criterion}: {what}"] = None if one is None or not two else one / two
    return found


def of_map(rows: dict[str, list[TrialResult]]) -> dict[str, Any]:
    """What each method came to on one map, and how the others compare with the first."""
    summaries = {method: summary(found) for method, found in rows.items()}
    first, *others = summaries
    return {
        "backend": rows[first][0].backend,
        "methods": summaries,
        f"times less than {first}": {name: ratios(summaries[first], summaries[name]) for name in others},
        "settings": {method: found[0].settings for method, found in rows.items()},
    }


def trials(given: argparse.Namespace, folder: Path, method: str) -> list[Trial]:
    protocol, *size = given.start.split(":")
    _, dataset = opened(str(folder), str(given.data))
    names = dataset.frame_names("test")
    kept = tuple(name for place, name in enumerate(names) if (place % 5 == 1) == given.tuning_frames)
    plan = Plan(
        str(folder), str(given.data), protocol, (tuple(map(float, size)),), method, "{}", given.trials,
        given.seed, frames=kept,
    )  # fmt: skip
    return planned(plan)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--map", type=Path, nargs="+", required=True)
    parser.add_argument("--start", default="bid:0.5")
    parser.add_argument("--methods", nargs="+", default=["bid", "bid-lm"])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--name", required=True, help="of the record")
    parser.add_argument("--tuning-frames", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if len({m.name for m in given.map}) < len(given.map):
        raise SystemExit(
            "--map: two folders have one name, expected different ones: records and trials go by it"
        )
    wanted = {(m, method): trials(given, m, method) for m in given.map for method in given.methods}
    partial = RESULTS / f"{given.name}.partial.jsonl"
    with ResultsFile(partial) as file:
        for same_start in zip(*wanted.values(), strict=True):
            for trial in same_start:
                if key_of(trial) not in file.results:
                    file.add(run_trial(trial))
            print(".", end="", flush=True)
        print()
        rows = {which: [file.results[key_of(t)] for t in listed] for which, listed in wanted.items()}
    maps = {m.name: of_map({x: rows[m, x] for x in given.methods}) for m in given.map}
    print(write_record(given.name, {"data": given.data.name, "start": given.start, "maps": maps}, given.seed))
    print(json.dumps({name: found["methods"] for name, found in maps.items()}, indent=1))
    partial.unlink()


if __name__ == "__main__":
    main()
