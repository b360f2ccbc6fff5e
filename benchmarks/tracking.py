r"""Track a sequence in a map: error, undetected losses, recovery from faults, consistency, time and memory, beside baselines.

    BIDNERF_DATA=FOLDER BIDNERF_MAPS=FOLDER python benchmarks/tracking.py --name tracking
    python benchmarks/tracking.py MAP:SEQUENCE [MAP:SEQUENCE ...] --name tracking
    python benchmarks/tracking.py MAP:SEQUENCE --memory 10000 --name tracking_memory

Without arguments, the sequences are TUM and the corridor in the maps that ``answer_maps.py`` has trained.

Each sequence is tracked in chronological order; and its first 160 frames backwards, with every 2nd and 4th frame, and with
faults; with depth and without. Frames of splits other than the training split are also summarised separately. Baselines:
method ``auto`` anew on every 6th frame, and generalised ICP from its own last pose (small_gicp). Frames with only depth, which
a LiDAR records between photos, are left out of runs without depth. Settings were chosen on the training frames of
tum_fr1_xyz alone (``--tuning-frames`` takes only those), and on no other frames or sequences.

``--memory COUNT`` shows that many frames to one tracker instead, forwards, backwards, and so on, and records its memory. The
frames are read once, so that any growth is the tracker's. In every thousand frames the camera is covered for five.

Everything runs in one process of one thread; finished runs are kept, so that an interrupted benchmark can be resumed.
"""

from __future__ import annotations

import argparse
import gc
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import torch
import torch.nn.functional as F
from _lab import RESULTS, RowStore, folder_of, map_folder, one_thread, parser, record

from bidnerf import SE3, Frame, Localization, Localizer, Map, Outcome, Tracker, load_map
from bidnerf.results import TrajectoryErrors, pose_error, spans, within
from bidnerf_core.datasets import TimedFrame, open_sequence

SEQUENCES = ("tum_fr1_xyz", "iphone_corridor")
WRONG = 0.05, 5.0
"""An accepted pose with a larger error (metres, degrees) is an undetected loss."""
RIGHT = 0.02, 1.0
"""A rejected pose with a smaller error counts as one that should have been accepted."""
EVERY = 1000
"""The number of frames after which memory is read."""
COVERED = range(500, 505)
"""The frames of every thousand that see nothing."""
SHORT = 160
"""The number of frames in all runs except those "in order"."""
FIRST = 40
"""The number of the frame at which faults begin."""

Frames = list[TimedFrame]


@dataclass(frozen=True)
class Run:
    """A sequence as shown to a tracker, and the frames in which its scene is not visible."""

    frames: Frames
    blind: range = range(0)
    returns: int | None = None  # the frame in which the scene is visible again, or another part of it


def whole(frames: Frames) -> Run:
    return Run(frames)


def thin(every: int) -> Callable[[Frames], Run]:
    return lambda frames: Run(frames[::every])


def backwards(frames: Frames) -> Run:
    return Run(frames[::-1])


def cover(frames: Frames) -> Run:
    """Cover the camera for 15 frames, which then show dark noise."""
    dark = partial(covered_frame, generator=torch.Generator().manual_seed(0))
    return change_part(frames, range(FIRST, FIRST + 15), dark)


def covered_frame(frame: Frame, generator: torch.Generator) -> Frame:
    """Return the frame as taken with the lens covered: dark noise, and no depth."""
    noise = 0.02 + 0.01 * torch.rand(frame.rgb.shape, generator=generator)
    return replace(frame, rgb=noise, depth=None if frame.depth is None else torch.zeros_like(frame.depth))


def plain_wall(frames: Frames) -> Run:
    """Show a wall of one colour, a metre away, with noise, for 30 frames."""
    generator = torch.Generator().manual_seed(0)

    def wall(frame: Frame) -> Frame:
        rgb = (0.6 + 0.02 * torch.randn(frame.rgb.shape, generator=generator)).clamp(0, 1)
        return replace(frame, rgb=rgb, depth=None if frame.depth is None else torch.full_like(frame.depth, 1.0))

    return change_part(frames, range(FIRST, FIRST + 30), wall)


def cover_half(frames: Frames) -> Run:
    """Move a textured object with depth over the left half of the image for 30 frames; the scene stays visible."""
    shifts = iter(range(0, 10**6, 3))

    def half(frame: Frame) -> Frame:
        height, width = frame.rgb.shape[:2]
        pattern = torch.rand((1, 3, 60, 80), generator=torch.Generator().manual_seed(0))
        texture = F.interpolate(pattern, size=(height, width), mode="bicubic")[0].permute(1, 2, 0).clamp(0, 1)
        rgb, shift = frame.rgb.clone(), next(shifts)
        rgb[:, : width // 2] = texture.roll((shift, 2 * shift), (0, 1))[:, : width // 2]
        depth = None if frame.depth is None else frame.depth.clone()
        if depth is not None:
            depth[:, : width // 2] = 0.6 + 0.002 * shift
        return replace(frame, rgb=rgb, depth=depth)

    return Run(change_part(frames, range(FIRST, FIRST + 30), half).frames)


def carry_on(frames: Frames) -> Run:
    """Leave out up to 100 frames, and close the gap in the time stamps."""
    there = min(FIRST + 100, len(frames) - 20)
    before, after = frames[:FIRST], frames[there:]
    if before[-1].time is None or after[0].time is None or frames[FIRST].time is None:
        return Run(before + after, returns=FIRST)
    late = after[0].time - frames[FIRST].time  # type: ignore[operator]
    return Run(before + [replace(f, time=f.time - late) for f in after], returns=FIRST)  # type: ignore[operator]


def depth_stops(frames: Frames) -> Run:
    """Remove the depth of the second half, and the frames there that have nothing else."""
    half = len(frames) // 2
    bare = [replace(f, frame=f.frame.replace(depth=None)) for f in frames[half:] if f.frame.has_colour]
    return Run(frames[:half] + bare)


def exposure_ramp(frames: Frames) -> Run:
    """Change the exposure evenly from two stops under to two stops over, in linear light."""
    count = len(frames)

    def exposed(number: int, frame: Frame) -> Frame:
        linear = frame.rgb**2.2 * 2 ** (4 * number / count - 2)
        return replace(frame, rgb=linear.clamp(0, 1) ** (1 / 2.2))

    return Run([replace(f, frame=exposed(i, f.frame)) for i, f in enumerate(frames)])


def double_frames(frames: Frames) -> Run:
    return Run([frame for frame in frames for _ in range(2)])


def out_of_order(frames: Frames) -> Run:
    """Exchange every seventh frame with the next."""
    mixed = list(frames)
    for place in range(5, len(mixed) - 1, 7):
        mixed[place], mixed[place + 1] = mixed[place + 1], mixed[place]
    return Run(mixed)


def without_times(frames: Frames) -> Run:
    return Run([replace(frame, time=None) for frame in frames])


def without_depth_frames(run: Run) -> Run:
    """Return the run with only colours."""
    kept = [number for number, timed in enumerate(run.frames) if timed.frame.has_colour]
    blind = [place for place, number in enumerate(kept) if number in run.blind]
    returns = None if run.returns is None else sum(number < run.returns for number in kept)
    part = range(blind[0], blind[-1] + 1) if blind else range(0)
    return Run([run.frames[number] for number in kept], part, returns)


def change_part(frames: Frames, part: range, change: Callable[[Frame], Frame]) -> Run:
    """Change the frames of a part, in which nothing of the scene is visible then."""
    shown = [replace(f, frame=change(f.frame)) if i in part else f for i, f in enumerate(frames)]
    return Run(shown, part, part.stop)


ORDERS: dict[str, Callable[[Frames], Run]] = {
    "in order": whole,
    "every 2nd": thin(2),
    "every 4th": thin(4),
    "backwards": backwards,
}
FAULTS: dict[str, Callable[[Frames], Run]] = {
    "covered for 15 frames": cover,
    "carried 100 frames on": carry_on,
    "plain wall for 30 frames": plain_wall,
    "half the image covered": cover_half,
    "depth stops": depth_stops,
    "exposure ramp": exposure_ramp,
    "frames doubled": double_frames,
    "frames out of order": out_of_order,
    "no time stamps": without_times,
}


# Baselines.


class EachAnew:
    """Method ``auto`` on each frame, without information from earlier frames."""

    def __init__(self, localizer: Localizer) -> None:
        self._localizer = localizer

    def __call__(self, frame: Frame, time: float | None) -> Localization:
        return self._localizer(frame)


class GicpFromLast:
    """Generalised ICP (small_gicp) of measured points to the map's surface, from the last pose; it accepts all its poses."""

    def __init__(self, localizer: Localizer) -> None:
        import small_gicp

        assert localizer.scene.surface is not None
        self._gicp, self._localizer, self._surface = small_gicp, localizer, localizer.scene.surface
        self._voxel = 2 * self._surface.cell
        self._target, self._tree = small_gicp.preprocess_points(
            self._surface.surfels.positions.double().numpy(), self._voxel, num_threads=1
        )
        self._last: SE3 | None = None

    def __call__(self, frame: Frame, time: float | None) -> Localization:
        if self._last is None or not frame.has_depth:
            found = self._localizer(frame)
            self._last = found.T_world_camera
            return found
        assert frame.depth is not None
        ray = frame.intrinsics.unproject(frame.intrinsics.pixel_centres(torch.float64))
        points = (ray * frame.depth.double()[..., None])[frame.depth > 0]
        source, _ = self._gicp.preprocess_points(points.numpy(), self._voxel, num_threads=1)
        done = self._gicp.align(
            self._target,
            source,
            self._tree,
            self._last.matrix().numpy(),
            registration_type="GICP",
            max_correspondence_distance=5 * self._voxel,
            num_threads=1,
        )
        self._last = SE3.from_matrix(torch.from_numpy(done.T_target_source).double())
        return Localization(
            self._last,
            Outcome.CONVERGED,
            "",
            1,
            0.0,
            float(done.error),
            "gicp",
            self._last[None],
            torch.zeros(1),
        )


# Tracking.


def track_run(run: Run, step: Callable[[Frame, float | None], Localization], depth: bool) -> list[dict[str, Any]]:
    """Track a run; return one row per frame."""
    rows = []
    for timed in run.frames:
        frame = timed.frame if depth else timed.frame.replace(depth=None)
        began = time.process_time()
        found = step(frame, timed.time)
        seconds = time.process_time() - began
        rows.append(_row(timed, found, seconds))
    return rows


def _row(timed: TimedFrame, found: Localization, seconds: float) -> dict[str, Any]:
    row: dict[str, Any] = {
        "frame": timed.frame.name,
        "split": timed.split,
        "accepted": found.converged,
        "cpu_seconds": seconds,
        "pose": found.T_world_camera.matrix().tolist(),
        "truth": None,
    }
    if timed.truth is None:
        return row
    error = pose_error(found.T_world_camera, timed.truth)
    row |= {"translation": float(error.translation), "rotation_deg": float(error.rotation_deg)}
    row |= {"truth": timed.truth.matrix().tolist(), "inside": None}
    if found.covariance is not None:
        row["inside"] = bool(within(found.T_world_camera, timed.truth, found.covariance))
    return row


def frames_until_accepted(rows: Sequence[dict[str, Any]], first: int) -> int:
    """Return the number of frames, counted from ``first``, up to the first accepted pose; 1 if it is that of ``first``."""
    later = (number for number, row in enumerate(rows[first:], start=1) if row["accepted"])
    return next(later, len(rows) - first + 1)


def summary(rows: Sequence[dict[str, Any]], blind: range = range(0), returns: int | None = None) -> dict[str, Any]:
    """Return errors of accepted poses, how well the answers judge themselves, recovery, and time."""
    known = [r for r in rows if r["truth"] is not None]
    accepted = [r for r in known if r["accepted"]]
    seeing = [r for i, r in enumerate(rows) if i not in blind and r["truth"] is not None]
    inside = [r["inside"] for r in accepted if r["inside"] is not None]
    times = [r["cpu_seconds"] for r in rows]
    found: dict[str, Any] = {
        "frames": len(rows),
        "accepted": len(accepted),
        "accepted_but_wrong": sum(not _near(r, WRONG) for r in accepted),
        "accepted_while_blind": sum(rows[i]["accepted"] for i in blind if i < len(rows)),
        "right_but_rejected": sum(_near(r, RIGHT) and not r["accepted"] for r in seeing),
        "rejected_in_sight": sum(not r["accepted"] for r in seeing),
        "in_sight": len(seeing),
        "frames_to_recover": None if returns is None else frames_until_accepted(rows, returns),
        "longest_loss_in_sight": max((b - a + 1 for a, b in _losses(rows, blind)), default=0),
        "inside_95": None if not inside else sum(inside) / len(inside),
        "cpu_ms": {
            "median": 1000 * statistics.median(times),
            "mean": 1000 * statistics.mean(times),
            "p95": 1000 * sorted(times)[int(0.95 * (len(times) - 1))],
        },
    }
    if accepted:
        poses = [torch.tensor([r[name] for r in accepted], dtype=torch.float64) for name in ("pose", "truth")]
        found["errors"] = asdict(TrajectoryErrors.of(*(SE3.from_matrix(m) for m in poses)))
    return found


def _near(row: dict[str, Any], limit: tuple[float, float]) -> bool:
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
            runs.append((f"{kind}, auto on every 6th", thin(6), depth, partial(EachAnew, localizer)))
    if find_spec("small_gicp") is not None:
        runs.append(("RGB-D, GICP from the last pose", whole, True, partial(GicpFromLast, localizer)))
    return runs


def sequence(stored: Map, path: Path, given: argparse.Namespace, store: RowStore) -> dict[str, Any]:
    frames, localizer = list(open_sequence(path))[: given.first], Localizer(stored)
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
        rows = store.get(key, lambda run=run, make=make, depth=depth: track_run(run, make(), depth))
        found[name] = summary(rows, run.blind, run.returns)
        held_out = [row for row in rows if row["split"] not in (None, "train")]
        if held_out and len(held_out) < len(rows):
            found[name]["held_out"] = summary(held_out)
        print(_line(path.name, name, found[name]), flush=True)
    return found


def _line(sequence: str, name: str, s: dict[str, Any]) -> str:
    errors = s.get("errors")
    raw = (
        "no pose"
        if errors is None
        else (
            f"median {errors['raw']['translation_median']:.4f} m {errors['raw']['rotation_deg_median']:.2f} deg,"
            f" p95 {errors['raw']['translation_p95']:.4f} m"
        )
    )
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


# Memory.


def back_and_forth(frames: Frames, count: int) -> Iterator[TimedFrame]:
    """Yield ``count`` frames: the sequence forwards, backwards, and so on; time advances by the true intervals."""
    around = [*range(len(frames)), *range(len(frames) - 2, 0, -1)]
    now, before = 0.0, frames[0]
    for number in range(count):
        timed = frames[around[number % len(around)]]
        if timed.time is not None and before.time is not None:
            now += abs(timed.time - before.time)
        before = timed
        yield replace(timed, time=None if timed.time is None else now)


def resident_bytes() -> int:
    """Return the physical memory that this process occupies."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def track_in_thousands(tracker: Tracker, frames: Iterator[TimedFrame], depth: bool) -> Iterator[dict[str, Any]]:
    """Track the frames; yield one row per thousand."""
    generator = torch.Generator().manual_seed(0)
    milliseconds, counts = list[float](), dict.fromkeys(("accepted", "wrong", "accepted_while_covered"), 0)
    for number, timed in enumerate(frames, start=1):
        hidden = (number - 1) % EVERY in COVERED
        frame = covered_frame(timed.frame, generator) if hidden else timed.frame
        frame = frame if depth else frame.replace(depth=None)
        began = time.process_time()
        found = tracker(frame, timed.time)
        milliseconds.append(1000 * (time.process_time() - began))
        if found.converged and timed.truth is not None:
            error = pose_error(found.T_world_camera, timed.truth)
            counts["accepted_while_covered"] += hidden
            counts["accepted"] += not hidden
            counts["wrong"] += bool(error.translation > WRONG[0] or error.rotation_deg > WRONG[1])
        if number % EVERY == 0:
            cpu = {"median": statistics.median(milliseconds), "mean": statistics.mean(milliseconds)}
            objects = len(gc.get_objects())
            yield {
                "frames": number,
                "resident_bytes": resident_bytes(),
                "python_objects": objects,
                "cpu_ms": cpu,
            } | counts
            milliseconds, counts = [], dict.fromkeys(counts, 0)


def memory(stored: Map, path: Path, count: int, depth: bool) -> dict[str, Any]:
    """Track ``count`` frames in one tracker, and return its memory and its counts by thousands."""
    frames = list(open_sequence(path))
    results: dict[str, Any] = {
        "sequence": path.name,
        "depth": depth,
        "resident_bytes_before": resident_bytes(),
        "rows": [],
    }
    for row in track_in_thousands(Tracker(Localizer(stored)), back_and_forth(frames, count), depth):
        results["rows"].append(row)
        print(row, flush=True)
    return results


def main() -> None:
    arguments = parser(__doc__, "tracking")
    arguments.add_argument("scenes", nargs="*", metavar="MAP:SEQUENCE")
    arguments.add_argument("--tuning-frames", action="store_true", help="the training split alone")
    arguments.add_argument("--quick", action="store_true", help="leave out auto on each frame, which takes longest")
    arguments.add_argument("--first", type=int, help="the first frames of each sequence alone")
    arguments.add_argument("--only", nargs="*", default=(), help="runs whose names contain one of these")
    arguments.add_argument("--memory", type=int, metavar="COUNT", help="track that many frames in one tracker instead")
    arguments.add_argument("--no-depth", action="store_true", help="with --memory: show colours alone")
    given = arguments.parse_args()
    one_thread()
    results: dict[str, Any] = {"sift_cpu_ms": sift_milliseconds()}
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        for pair in given.scenes or [f"{map_folder(s)}:{folder_of('BIDNERF_DATA') / s}" for s in SEQUENCES]:
            folder, path = map(Path, pair.split(":", 1))
            stored = load_map(folder)
            if given.memory:
                results |= memory(stored, path, given.memory, not given.no_depth)
            else:
                results[path.name] = sequence(stored, path, given, store)
    record(given.name, results)


if __name__ == "__main__":
    main()
