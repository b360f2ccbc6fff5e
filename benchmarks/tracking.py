r"""Track a sequence in a map: error, undetected losses, recovery from faults, consistency and time, and those of baselines.

    python benchmarks/tracking.py MAP:SEQUENCE [MAP:SEQUENCE ...] --name tracking

Each sequence is tracked in chronological order; and its first 160 frames backwards, with every 2nd and 4th frame, with a
window of several frames on noisy depth, and with faults; with depth and without. Frames of splits other than the training
split are also summarised separately. Baselines: method ``auto`` anew on every 6th frame, generalised ICP from its own last pose
(small_gicp), and, where it is installed, Open3D's odometry. Frames with only depth, which a LiDAR records between photos, are
left out of runs without depth. Settings were chosen on the training frames of tum_fr1_xyz alone (``--tuning-frames`` takes only
those), and on no other frames or sequences. Everything runs in one process of one thread; finished runs are kept, so that an
interrupted benchmark can be resumed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import torch
from scipy.stats import chi2
from tracking_baselines import EachAnew, GicpFromLast, Open3dOdometry
from tracking_runs import (
    FAULTS,
    ORDERS,
    SHORT,
    Frames,
    Run,
    noisy_depth,
    thinned,
    whole,
    without_depth_frames,
)

from bidnerf_core import SE3, Frame, Localizer, Map, Tracker, TrackerConfig, load_map
from bidnerf_core.datasets import TimedFrame, open_sequence
from bidnerf_core.evaluation.json_lines import RowStore
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.localization import Localization
from bidnerf_core.results.errors import normalized_error_squared, pose_error
from bidnerf_core.results.trajectory import TrajectoryErrors, spans

RESULTS = Path(__file__).resolve().parent / "results"
BOUND = float(chi2.ppf(0.95, 6))
WRONG = 0.05, 5.0
"""An accepted pose with a larger error (metres, degrees) is an undetected loss."""
RIGHT = 0.02, 1.0
"""A rejected pose with a smaller error counts as one that should have been accepted."""
WINDOWS = (1, 4, 8)


def read(path: Path) -> Frames:
    return list(open_sequence(path))


def tracked(
    run: Run, step: Callable[[Frame, float | None], Localization], depth: bool
) -> list[dict[str, Any]]:
    """Track a run; return one row per frame."""
    rows = []
    for timed in run.frames:
        frame = timed.frame if depth else replace(timed.frame, depth=None)
        began = time.process_time()
        found = step(frame, timed.time)
        seconds = time.process_time() - began
        rows.append(_row(timed, found, seconds))
    return rows


def _row(timed: TimedFrame, found: Localization, seconds: float) -> dict[str, Any]:
    row: dict[str, Any] = {
        "frame": timed.frame.name, "split": timed.split, "accepted": found.converged, "cpu_seconds": seconds,
        "pose": found.T_world_camera.matrix().tolist(), "truth": None,
    }  # fmt: skip
    if timed.truth is None:
        return row
    error = pose_error(found.T_world_camera, timed.truth)
    row |= {"translation": float(error.translation), "rotation_deg": float(error.rotation_deg)}
    row |= {"truth": timed.truth.matrix().tolist(), "inside": None}
    if found.covariance is not None:
        squared = normalized_error_squared(found.T_world_camera, timed.truth, found.covariance)
        row["inside"] = bool(squared <= BOUND)
    return row


def frames_until_accepted(rows: Sequence[dict[str, Any]], first: int) -> int:
    """Return the number of frames, counted from ``first``, up to the first accepted pose; 1 if it is that of ``first``."""
    later = (number for number, row in enumerate(rows[first:], start=1) if row["accepted"])
    return next(later, len(rows) - first + 1)


def summary(
    rows: Sequence[dict[str, Any]], blind: range = range(0), returns: int | None = None
) -> dict[str, Any]:
    """Return errors of accepted poses, how well the answers judge themselves, recovery, and time."""
    known = [r for r in rows if r["truth"] is not None]
    accepted = [r for r in known if r["accepted"]]
    seeing = [r for i, r in enumerate(rows) if i not in blind and r["truth"] is not None]
    inside = [r["inside"] for r in accepted if r["inside"] is not None]
    times = [r["cpu_seconds"] for r in rows]
    found: dict[str, Any] = {
        "frames": len(rows),
        "accepted": len(accepted),
        "accepted_but_wrong": sum(not _within(r, WRONG) for r in accepted),
        "accepted_while_blind": sum(rows[i]["accepted"] for i in blind if i < len(rows)),
        "right_but_rejected": sum(_within(r, RIGHT) and not r["accepted"] for r in seeing),
        "rejected_in_sight": sum(not r["accepted"] for r in seeing),
        "in_sight": len(seeing),
        "frames_to_recover": None if returns is None else frames_until_accepted(rows, returns),
        "longest_loss_in_sight": max((b - a + 1 for a, b in _losses(rows, blind)), default=0),
        "inside_95": None if not inside else sum(inside) / len(inside),
        "cpu_ms": {
            "median": 1000 * statistics.median(times), "mean": 1000 * statistics.mean(times),
            "p95": 1000 * sorted(times)[int(0.95 * (len(times) - 1))],
        },
    }  # fmt: skip
    if accepted:
        poses = [torch.tensor([r[name] for r in accepted], dtype=torch.float64) for name in ("pose", "truth")]
        found["errors"] = asdict(TrajectoryErrors.of(*(SE3.from_matrix(m) for m in poses)))
    return found


def _within(row: dict[str, Any], limit: tuple[float, float]) -> bool:
    return bool(row["translation"] <= limit[0] and row["rotation_deg"] <= limit[1])


def _losses(rows: Sequence[dict[str, Any]], blind: range) -> list[tuple[int, int]]:
    return spans([not r["accepted"] and i not in blind for i, r in enumerate(rows)])


def plan(localizer: Localizer, quick: bool) -> list[tuple[str, Callable[[Frames], Run], bool, Any]]:
    """Return all runs: name, the change to the sequence, whether depth is used, and the factory of the tracker."""
    track = partial(Tracker, localizer)
    runs: list[tuple[str, Callable[[Frames], Run], bool, Any]] = []
    for kind, depth in (("RGB-D", True), ("RGB", False)):
        runs += [(f"{kind}, {name}", order, depth, track) for name, order in ORDERS.items()]
        runs += [(f"{kind}, {name}", fault, depth, track) for name, fault in FAULTS.items()]
        if not quick:
            runs.append((f"{kind}, auto on every 6th", thinned(6), depth, partial(EachAnew, localizer)))
    runs.append(("RGB-D, GICP from the last pose", whole, True, partial(GicpFromLast, localizer)))
    if find_spec("open3d") is not None:
        name = "RGB-D, Open3D's odometry with relocalization"
        runs.append((name, whole, True, partial(Open3dOdometry, localizer)))
    for size in WINDOWS:
        config = TrackerConfig(window=size)
        runs.append(
            (f"RGB-D, noisy depth, K = {size}", noisy_depth, True, partial(Tracker, localizer, config))
        )
    return runs


def sequence(stored: Map, path: Path, given: argparse.Namespace, store: RowStore) -> dict[str, Any]:
    frames, localizer = read(path)[: given.first], Localizer(stored)
    if given.tuning_frames:
        frames = [frame for frame in frames if frame.split == "train"]
    found: dict[str, Any] = {}
    for name, change, depth, make in plan(localizer, given.quick):
        if given.only and not any(word in name for word in given.only):
            continue
        run = change(frames if name.endswith("in order") else frames[:SHORT])
        if not depth:  # frames with only depth would then show nothing
            run = without_depth_frames(run)
        key = [path.name, stored.info.weights, name, len(run.frames), given.tuning_frames]
        rows = store.get(key, lambda run=run, make=make, depth=depth: tracked(run, make(), depth))
        found[name] = summary(rows, run.blind, run.returns)
        held_out = [row for row in rows if row["split"] not in (None, "train")]
        if held_out and len(held_out) < len(rows):
            found[name]["held_out"] = summary(held_out)
        print(_line(path.name, name, found[name]), flush=True)
    return found


def _line(sequence: str, name: str, s: dict[str, Any]) -> str:
    errors = s.get("errors")
    raw = "no pose" if errors is None else (
        f"median {errors['raw']['translation_median']:.4f} m {errors['raw']['rotation_deg_median']:.2f} deg,"
        f" p95 {errors['raw']['translation_p95']:.4f} m"
    )  # fmt: skip
    inside = "-" if s["inside_95"] is None else f"{s['inside_95']:.3f}"
    return (
        f"{sequence} {name}: {s['accepted']}/{s['frames']}, wrong {s['accepted_but_wrong']}, blind"
        f" {s['accepted_while_blind']}, right rejected {s['right_but_rejected']}, recovered in"
        f" {s['frames_to_recover'] or '-'}, longest loss"
        f" {s['longest_loss_in_sight']}, {raw}, inside {inside}, CPU ms {s['cpu_ms']['median']:.0f}"
        f" (mean {s['cpu_ms']['mean']:.0f})"
    )


def sift_milliseconds() -> float:
    """Return the CPU time of SIFT on a 320 x 240 image, as a reference for times on a busy machine."""
    image = (255 * torch.rand((240, 320), generator=torch.Generator().manual_seed(0))).byte().numpy()
    image = cv2.GaussianBlur(image, (0, 0), 1.5)
    times = []
    for _ in range(20):
        began = time.process_time()
        cv2.SIFT.create(nfeatures=600).detectAndCompute(image, None)
        times.append(time.process_time() - began)
    return 1000 * statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", help="MAP:SEQUENCE")
    parser.add_argument("--name", default="tracking", help="of the record")
    parser.add_argument("--tuning-frames", action="store_true", help="the training split alone")
    parser.add_argument(
        "--quick", action="store_true", help="leave out auto on each frame, which takes longest"
    )
    parser.add_argument("--first", type=int, help="the first frames of each sequence alone")
    parser.add_argument("--only", nargs="*", default=(), help="runs whose names contain one of these")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    kept = RESULTS / f"{given.name}.partial.jsonl"
    results: dict[str, Any] = {"sift_cpu_ms": sift_milliseconds()}
    with RowStore(kept) as store:
        for pair in given.scenes:
            folder, path = map(Path, pair.split(":"))
            results[path.name] = sequence(load_map(folder), path, given, store)
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))
    kept.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
