"""Success of a method on a map from seeded starts, on frames that training never saw.

    python benchmarks/localization.py MAP DATA --start bid:0.5 --trials 40 --name localization_lego_bid_0.5

``--start bid:SIZE`` and ``bid-hard:SIZE`` are the protocols of the same names; ``--start METRES:DEGREES`` moves the true
pose by exactly that much. Frames whose place in the test split is 1 modulo 5 are left out by default: settings were
tuned on them. Trials run in processes of one thread; finished ones are kept in a ``.jsonl`` beside the record, so that
an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from record import RESULTS, write_record

from bidnerf_core.datasets import Dataset, open_dataset
from bidnerf_core.evaluation import protocols
from bidnerf_core.evaluation.errors import CRITERIA, PoseError, pose_error, steps_to_success, success_rate
from bidnerf_core.localization import find_method, localize, single
from bidnerf_core.plain import from_plain, to_plain
from bidnerf_core.se3 import SE3
from bidnerf_core.storage import Map, load_map


@dataclass(frozen=True)
class Trial:
    """All that a trial depends on."""

    map: str
    data: str
    frame: str
    start: str
    method: str
    config: str  # JSON
    seed: int


@cache
def opened(map_folder: str, data: str) -> tuple[Map, Dataset]:
    torch.set_num_threads(1)
    stored = load_map(Path(map_folder))
    return stored, open_dataset(data, stored.bounds.background)


def start_pose(rule: str, truth: SE3, seed: int) -> SE3:
    kind, _, size = rule.partition(":")
    if kind == "bid":
        return protocols.bid(truth, float(size), seed)
    if kind == "bid-hard":
        return protocols.bid_hard(truth, float(size), seed)
    return protocols.perturb(truth, float(kind), float(size), seed)


def run(trial: Trial) -> dict[str, Any]:
    """One line of results."""
    stored, dataset = opened(trial.map, trial.data)
    (view,) = dataset.views("test", [trial.frame])
    truth = view.T_ref_camera
    config = from_plain(find_method(trial.method).config_type, json.loads(trial.config), "--config")
    start = start_pose(trial.start, truth, trial.seed)
    found = localize(single(stored.field, stored.bounds, view.frame, start), trial.method, config, trial.seed)
    errors = pose_error(found.poses, truth)
    return {
        "frame": trial.frame,
        "seed": trial.seed,
        "converged": found.converged,
        "steps": found.steps,
        "seconds": found.seconds,
        "loss": found.loss,
        "peak_resident_GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        "translation": errors.translation.tolist(),
        "rotation_deg": errors.rotation_deg.tolist(),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Rates by each criterion with Wilson intervals, steps, time, and how honest ``converged`` was."""
    traces = [PoseError(torch.tensor(r["translation"]), torch.tensor(r["rotation_deg"])) for r in rows]
    result: dict[str, Any] = {"trials": len(rows)}
    for name, criterion in CRITERIA.items():
        good = [bool(criterion(trace[-1], trace[0])) for trace in traces]
        result[name] = asdict(success_rate(sum(good), len(rows)))
        reached = [s for trace in traces if (s := steps_to_success(trace, criterion)) is not None]
        result[name]["median_steps_to_success"] = statistics.median(reached) if reached else None
    right = [bool(CRITERIA["5deg 0.05"](trace[-1], trace[0])) for trace in traces]
    said = [row["converged"] for row in rows]
    result["converged_but_wrong"] = sum(s and not r for s, r in zip(said, right, strict=True))
    result["right_but_not_converged"] = sum(r and not s for s, r in zip(said, right, strict=True))
    result["median_translation"] = statistics.median(row["translation"][-1] for row in rows)
    result["median_rotation_deg"] = statistics.median(row["rotation_deg"][-1] for row in rows)
    result["median_start_rotation_deg"] = statistics.median(row["rotation_deg"][0] for row in rows)
    result["seconds_per_step"] = statistics.median(row["seconds"] / row["steps"] for row in rows)
    result["peak_resident_GiB"] = max(row["peak_resident_GiB"] for row in rows)
    return result


def trials(given: argparse.Namespace) -> list[Trial]:
    _, dataset = opened(str(given.map), str(given.data))
    names = dataset.frame_names("test")
    kept = [n for i, n in enumerate(names) if given.all_frames or i % 5 != 1]
    config = json.dumps(json.loads(given.config), sort_keys=True)
    return [
        Trial(
            str(given.map),
            str(given.data),
            kept[i % len(kept)],
            given.start,
            given.method,
            config,
            given.seed + i,
        )
        for i in range(given.trials)
    ]


def finished(path: Path) -> dict[str, dict[str, Any]]:
    if not path.exists():
        return {}
    lines = [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]
    return {line["key"]: line["row"] for line in lines}


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
    partial = RESULTS / f"{given.name}.partial.jsonl"
    done, wanted = finished(partial), trials(given)
    stamp = load_map(given.map).info.weights  # a map trained anew starts over
    keys = {json.dumps([asdict(t), stamp]): t for t in wanted}
    with ProcessPoolExecutor(given.workers) as pool, partial.open("a") as file:
        waiting = {pool.submit(run, trial): key for key, trial in keys.items() if key not in done}
        for count, future in enumerate(as_completed(waiting), 1):
            done[waiting[future]] = future.result()
            file.write(json.dumps({"key": waiting[future], "row": future.result()}) + "\n")
            file.flush()
            print(f"{count}/{len(waiting)}", end="\r", flush=True)
    rows = [done[key] for key in keys]
    settings = to_plain(
        from_plain(find_method(given.method).config_type, json.loads(given.config), "--config")
    )
    results = {"map": given.map.name, "data": given.data.name, "start": given.start, "method": given.method}
    final = [{k: (v[-1] if isinstance(v, list) else v) for k, v in row.items()} for row in rows]
    record = {**results, "settings": settings, "summary": summary(rows), "rows": final}
    print(write_record(given.name, record, given.seed))
    print(json.dumps(summary(rows), indent=1))
    partial.unlink()


if __name__ == "__main__":
    main()
