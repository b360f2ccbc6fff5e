r"""Compare methods on maps in one run, from the same starts, one after another.

    python benchmarks/localization_speed.py DATA --map MAP [MAP ...] --start bid:0.5 --methods bid bid-lm auto --trials 20 \
        --name speed_lego

``--start`` is a protocol, with a size where it has sizes: ``bid:SIZE``, ``perturb:METRES:DEGREES``, ``inerf``, ``none``.
The other methods are compared with the first one, on each map. Frames whose index in the test split is 1 modulo 5 are
left out, since settings were tuned on them; ``--tuning-frames`` takes only those. One process of one thread runs all
trials. Finished trials are kept in a ``.jsonl`` next to the record, so that an interrupted run resumes where it stopped.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.evaluation.bench import Plan, planned
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.results import ResultsFile, key_of
from bidnerf_core.evaluation.summary import Summary, summarize
from bidnerf_core.evaluation.trial import Trial, TrialResult
from bidnerf_core.evaluation.trials import opened, run_trial

RESULTS = Path(__file__).parent / "results"


def ratios(base: Summary, other: Summary) -> dict[str, float | None]:
    """Return how many times fewer steps and less time ``other`` takes than ``base``: in all, and to success."""
    found: dict[str, float | None] = {
        "steps": base.steps / other.steps,
        "seconds": base.seconds / other.seconds,
    }
    for name, one in base.criteria.items():
        two = other.criteria[name]
        if one is not None and two is not None:
            found[f"{name}: steps to success"] = _ratio(one.steps, two.steps)
            found[f"{name}: time to success"] = _ratio(one.milliseconds, two.milliseconds)
    return found


def _ratio(one: float | None, two: float | None) -> float | None:
    return None if one is None or not two else one / two


def of_map(rows: dict[str, list[TrialResult]]) -> dict[str, Any]:
    """Return the statistics of each method on one map, and how the others compare with the first."""
    summaries = {method: summarize(found) for method, found in rows.items()}
    first, *others = summaries
    return {
        "backend": rows[first][0].backend,
        "methods": {method: asdict(found) for method, found in summaries.items()},
        f"times less than {first}": {name: ratios(summaries[first], summaries[name]) for name in others},
        "settings": {method: found[0].settings for method, found in rows.items()},
    }


def trials(given: argparse.Namespace, folder: Path, method: str) -> list[Trial]:
    """Return the trials of one method on one map."""
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
    print(
        write_record(
            RESULTS / f"{given.name}.json",
            {"data": given.data.name, "start": given.start, "maps": maps},
            given.seed,
        )
    )
    print(json.dumps({name: found["methods"] for name, found in maps.items()}, indent=1))
    partial.unlink()


if __name__ == "__main__":
    main()
