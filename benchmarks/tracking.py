r"""Track a sequence in a map: error, undetected losses, recovery from faults, consistency, time; and what others reach.

    python benchmarks/tracking.py MAP:SEQUENCE [MAP:SEQUENCE ...] --name tracking

Each sequence is tracked in the order of time; and its first 160 frames backwards, with every 2nd and 4th frame, with a
window of several frames on noisy depth, and with faults; with depth and without. Frames of splits other than the training's are summarised apart, too.
Baselines: method ``auto`` on every 6th frame anew, generalised ICP from its own last pose (small_gicp), and, where it is
installed, Open3D's odometry. Frames of depth alone, which a LiDAR records between photos, are left out without depth.
Settings were chosen on the training frames of tum_fr1_xyz alone (``--tuning-frames`` takes only those); nothing was chosen by
other frames or sequences. One process of one thread; finished runs are kept, so that an interrupted benchmark goes on.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import torch
import torch.nn.functional as F
from scipy.stats import chi2

from bidnerf_core import SE3, Frame, Localizer, Map, Outcome, Tracker, TrackerConfig, load_map
from bidnerf_core.datasets import TimedFrame, open_sequence
from bidnerf_core.evaluation.errors import normalized_error_squared, pose_error
from bidnerf_core.evaluation.json_lines import RowStore
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.trajectory import TrajectoryErrors, spans
from bidnerf_core.localization import Localization

RESULTS = Path(__file__).resolve().parent / "results"
BOUND = float(chi2.ppf(0.95, 6))
WRONG = 0.05, 5.0
"""An accepted pose with a larger error (metres, degrees) is an undetected loss."""
RIGHT = 0.02, 1.0
"""A rejected pose with a smaller error counts as one that should have been accepted."""
SHORT = 160
"""The number of frames that all runs but those "in order" are shown."""
FIRST = 40
"""The number of the frame at which faults begin."""

Frames = list[TimedFrame]


@dataclass(frozen=True)
class Run:
    """A sequence as it is shown to a tracker, and the frames in which its scene is not to be seen."""

    frames: Frames
    blind: range = range(0)


def read(path: Path) -> Frames:
    return list(open_sequence(path))


def whole(frames: Frames) -> Run:
    return Run(frames)


def thinned(every: int) -> Callable[[Frames], Run]:
    return lambda frames: Run(frames[::every])


def backwards(frames: Frames) -> Run:
    return Run(frames[::-1])


def covered(frames: Frames) -> Run:
    """Cover the camera for 15 frames; what it takes then is dark noise."""
    dark = partial(covered_frame, generator=torch.Generator().manual_seed(0))
    return changed(frames, range(FIRST, FIRST + 15), dark)


def covered_frame(frame: Frame, generator: torch.Generator) -> Frame:
    """Return what the camera takes with its lens covered: dark noise, and no depth."""
    noise = 0.02 + 0.01 * torch.rand(frame.rgb.shape, generator=generator)
    return replace(frame, rgb=noise, depth=None if frame.depth is None else torch.zeros_like(frame.depth))


def plain_wall(frames: Frames) -> Run:
    """Show a wall of one colour, a metre away, with noise, for 30 frames."""
    generator = torch.Generator().manual_seed(0)

    def wall(frame: Frame) -> Frame:
        rgb = (0.6 + 0.02 * torch.randn(frame.rgb.shape, generator=generator)).clamp(0, 1)
        return replace(
            frame, rgb=rgb, depth=None if frame.depth is None else torch.full_like(frame.depth, 1.0)
        )

    return changed(frames, range(FIRST, FIRST + 30), wall)


def half_covered(frames: Frames) -> Run:
    """Move a textured thing with depth over the left half of the image for 30 frames; the scene stays in sight."""
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

    return Run(changed(frames, range(FIRST, FIRST + 30), half).frames)


def carried(frames: Frames) -> Run:
    """Leave out up to 100 frames without a trace in the time stamps."""
    there = min(FIRST + 100, len(frames) - 20)
    before, after = frames[:FIRST], frames[there:]
    if before[-1].time is None or after[0].time is None or frames[FIRST].time is None:
        return Run(before + after)
    late = after[0].time - frames[FIRST].time  # type: ignore[operator]
    return Run(before + [replace(f, time=f.time - late) for f in after])  # type: ignore[operator]


def depth_stops(frames: Frames) -> Run:
    part = range(len(frames) // 2, len(frames))
    return Run(changed(frames, part, lambda frame: replace(frame, depth=None)).frames)


def exposure_ramp(frames: Frames) -> Run:
    """Change the exposure evenly from two stops under to two stops over, in linear light."""
    count = len(frames)

    def exposed(number: int, frame: Frame) -> Frame:
        linear = frame.rgb**2.2 * 2 ** (4 * number / count - 2)
        return replace(frame, rgb=linear.clamp(0, 1) ** (1 / 2.2))

    return Run([replace(f, frame=exposed(i, f.frame)) for i, f in enumerate(frames)])


def doubled(frames: Frames) -> Run:
    return Run([frame for frame in frames for _ in range(2)])


def out_of_order(frames: Frames) -> Run:
    """Exchange every seventh frame with the next."""
    mixed = list(frames)
    for place in range(5, len(mixed) - 1, 7):
        mixed[place], mixed[place + 1] = mixed[place + 1], mixed[place]
    return Run(mixed)


def without_times(frames: Frames) -> Run:
    return Run([replace(frame, time=None) for frame in frames])


def noisy_depth(frames: Frames) -> Run:
    """Add noise of 2 % to the measured depth."""
    generator = torch.Generator().manual_seed(0)

    def noisy(frame: Frame) -> Frame:
        if frame.depth is None:
            return frame
        noise = 1 + 0.02 * torch.randn(frame.depth.shape, generator=generator)
        return replace(frame, depth=frame.depth * noise)

    return Run(changed(frames, range(len(frames)), noisy).frames)


def without_depth_frames(run: Run) -> Run:
    """Return the frames with colours alone."""
    kept = [number for number, timed in enumerate(run.frames) if timed.frame.has_colour]
    blind = [place for place, number in enumerate(kept) if number in run.blind]
    return Run([run.frames[number] for number in kept], range(blind[0], blind[-1] + 1) if blind else range(0))


def changed(frames: Frames, part: range, change: Callable[[Frame], Frame]) -> Run:
    return Run([replace(f, frame=change(f.frame)) if i in part else f for i, f in enumerate(frames)], part)


ORDERS: dict[str, Callable[[Frames], Run]] = {
    "in order": whole, "every 2nd": thinned(2), "every 4th": thinned(4), "backwards": backwards,
}  # fmt: skip
FAULTS: dict[str, Callable[[Frames], Run]] = {
    "covered for 15 frames": covered, "carried 100 frames on": carried, "plain wall for 30 frames": plain_wall,
    "half the image covered": half_covered, "depth stops": depth_stops, "exposure ramp": exposure_ramp,
    "frames doubled": doubled, "frames out of order": out_of_order, "no time stamps": without_times,
}  # fmt: skip
WINDOWS = (1, 4, 8)


class EachAnew:
    """Method ``auto`` on each frame, without what was known before."""

    def __init__(self, localizer: Localizer) -> None:
        self._localizer = localizer

    def __call__(self, frame: Frame, time: float | None) -> Localization:
        return self._localizer(frame)


class GicpFromLast:
    """Generalised ICP (small_gicp) between measured points and the map's surface, from the last pose; it judges nothing."""

    def __init__(self, localizer: Localizer) -> None:
        import small_gicp

        assert localizer.map.surface is not None
        self._gicp, self._localizer, self._surface = small_gicp, localizer, localizer.map.surface
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
            self._target, source, self._tree, self._last.matrix().numpy(), registration_type="GICP",
            max_correspondence_distance=5 * self._voxel, num_threads=1,
        )  # fmt: skip
        self._last = SE3.from_matrix(torch.from_numpy(done.T_target_source).double())
        return Localization(
            self._last, Outcome.CONVERGED, "", 1, 0.0, float(done.error),
            "gicp", self._last[None], torch.zeros(1),
        )  # fmt: skip


class Open3dOdometry:
    """Open3D's RGB-D odometry from frame to frame (Park et al. 2017), with ``auto`` at first, every 30 frames, and when it fails."""

    EVERY = 30

    def __init__(self, localizer: Localizer) -> None:
        import open3d

        self._o3d, self._localizer = open3d, localizer
        self._last: tuple[Any, SE3] | None = None
        self._age = 0

    def __call__(self, frame: Frame, time: float | None) -> Localization:
        image = self._image(frame)
        T = None if self._last is None or self._age >= self.EVERY else self._moved(frame, image, *self._last)
        if T is None:
            found = self._localizer(frame)
            self._age, self._last = 0, (image, found.T_world_camera) if found.converged else None
            return found
        self._age, self._last = self._age + 1, (image, T)
        return Localization(T, Outcome.CONVERGED, "", 1, 0.0, 0.0, "odometry", T[None], torch.zeros(1))

    def _moved(self, frame: Frame, image: Any, before: Any, T_world_before: SE3) -> SE3 | None:
        o3d, camera = self._o3d, frame.intrinsics
        pinhole = o3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5
        )
        done, T_before_now, _ = o3d.pipelines.odometry.compute_rgbd_odometry(
            image, before, pinhole, torch.eye(4, dtype=torch.float64).numpy(),
            o3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(),
        )  # fmt: skip
        return T_world_before @ SE3.from_matrix(torch.tensor(T_before_now).double()) if done else None

    def _image(self, frame: Frame) -> Any:
        geometry, depth = self._o3d.geometry, frame.depth
        assert depth is not None
        rgb = (255 * frame.rgb).round().byte().contiguous().numpy()
        return geometry.RGBDImage.create_from_color_and_depth(
            geometry.Image(rgb), geometry.Image(depth.float().contiguous().numpy()), 1.0, 10.0
        )


def tracked(
    run: Run, step: Callable[[Frame, float | None], Localization], depth: bool
) -> list[dict[str, Any]]:
    """Track a run; return a row a frame."""
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


def summary(rows: Sequence[dict[str, Any]], blind: range = range(0)) -> dict[str, Any]:
    """Return errors of accepted poses, how honest the answers are, recovery, and time."""
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
    """Return all runs: name, what is done to the sequence, whether depth is used, and what makes the tracker."""
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
        if not depth:  # frames of depth alone would then show nothing
            run = without_depth_frames(run)
        key = [path.name, stored.info.weights, name, len(run.frames), given.tuning_frames]
        rows = store.get(key, lambda run=run, make=make, depth=depth: tracked(run, make(), depth))
        found[name] = summary(rows, run.blind)
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
        f" {s['accepted_while_blind']}, right rejected {s['right_but_rejected']}, longest loss"
        f" {s['longest_loss_in_sight']}, {raw}, inside {inside}, CPU ms {s['cpu_ms']['median']:.0f}"
        f" (mean {s['cpu_ms']['mean']:.0f})"
    )


def sift_milliseconds() -> float:
    """Return the CPU time of SIFT on a 320 x 240 image, by which times on a busy machine can be compared."""
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
