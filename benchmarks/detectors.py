r"""Poses by landmarks of several detectors: maps of few photos, other resolutions, darkness, and the time of a query.

    python benchmarks/detectors.py DATA [DATA ...] [--detectors sift xfeat]

Landmarks are built of every k-th photo of the training split, with its depth where it has any, by each detector; no field is
trained. For each k, there are two such maps, of which one begins k/2 photos later. Frames of the test split, without depth, are
localized by these landmarks alone, and detectors take turns on each frame. "Night" is a tenth of the light, with the noise of
photons and of reading a sensor. ``xfeat, one grid`` finds keypoints as XFeat was published. Settings of the plugin were chosen
on some of these frames, at k = 8 and 4.

Everything runs on one thread; finished answers are kept, so that an interrupted run resumes where it stopped.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import torch
from _lab import (
    RESULTS,
    RIGHT,
    STRICT,
    Row,
    RowStore,
    cpu_seconds,
    in_turn,
    judgement,
    one_thread,
    parser,
    rates,
    record,
    times_slower,
    without_depth,
)

from bidnerf import SE3, Frame, View
from bidnerf.results import normalized_error_squared, pose_error
from bidnerf_core.captures import tried_landmarks
from bidnerf_core.datasets import Capture, open_dataset
from bidnerf_core.localization import LandmarkMatcher, Loop
from bidnerf_core.mapping import Features, find_features, track_views

EVERY = (2, 4, 8, 16)
ONE_GRID = "xfeat, one grid"
LIGHT, FULL_WELL, READ_NOISE = 0.1, 4000.0, 5.0
"""Share of the light at night, electrons of a saturated pixel by day, and the standard deviation of reading them."""
GAMMA = 2.2
BRIEFLY = ("n", "right", "strict", "accepted", "accepted_but_wrong", "times_slower")
"""What is recorded of two detectors in succession."""
ANSWERS = 2
"""Number of detections by which a detector is timed on each frame; the faster one counts."""


def at_night(frame: Frame) -> Frame:
    """Return the image as a sensor takes it in a tenth of the light, in the 256 shades of a file."""
    generator = torch.Generator().manual_seed(len(frame.name) + frame.intrinsics.width)
    electrons = torch.poisson(LIGHT * FULL_WELL * frame.rgb.clamp(0, 1) ** GAMMA, generator)
    electrons = electrons + READ_NOISE * torch.randn(electrons.shape, generator=generator)
    rgb = (electrons / FULL_WELL).clamp(0, 1) ** (1 / GAMMA)
    return replace(frame, rgb=(255 * rgb).round() / 255)


def resize(frame: Frame, factor: float) -> Frame:
    """Return the image at another resolution, with the matching camera."""
    camera = frame.intrinsics.scaled(factor)
    kind = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    rgb = cv2.resize(frame.rgb.numpy(), (camera.width, camera.height), interpolation=kind)
    return replace(frame, rgb=torch.from_numpy(rgb).clamp(0, 1), intrinsics=camera, alpha=None, depth=None)


CONDITIONS: dict[str, Callable[[Frame], Frame]] = {
    "as it is": lambda frame: frame,
    "half resolution": partial(resize, factor=0.5),
    "double resolution": partial(resize, factor=2.0),
    "night": at_night,
}


def detector(name: str) -> Features:
    if name == ONE_GRID:
        from bidnerf_xfeat.detector import CELL, XFeat

        return XFeat(step=CELL)
    return find_features(name)


def localize(landmarks: LandmarkMatcher, features: Features, query: View) -> Row:
    """Localize one frame by landmarks alone, and return its errors, whether its pose is accepted, and the CPU time."""
    began = time.process_time()
    found = Loop([View(query.frame, SE3.identity())], landmarks, features=features)()
    row: Row = {"cpu_seconds": time.process_time() - began, "converged": False, "matches": 0}
    row |= dict.fromkeys(("translation", "rotation_deg", "normalized_error_squared"))
    if found is None:
        return row
    error = pose_error(found.T_world_rig, query.T_ref_camera)
    squared = normalized_error_squared(found.T_world_rig, query.T_ref_camera, found.covariance)
    return row | {
        "converged": found.verdict.accepted,
        "matches": len(found.mode.matches),
        "translation": float(error.translation),
        "rotation_deg": float(error.rotation_deg),
        "normalized_error_squared": float(squared),
    }


class Maps:
    """The landmarks of one choice of photos, by detector, which are built when they are first needed."""

    def __init__(self, data: Capture, names: Sequence[str]) -> None:
        self._data, self._names = data, names
        self._built: dict[str, LandmarkMatcher] = {}

    def __getitem__(self, name: str) -> LandmarkMatcher:
        if name not in self._built:
            views = self._data.views("train", self._names)
            self._built[name] = LandmarkMatcher(tried_landmarks(track_views(views, detector(name)), views))
        return self._built[name]


def answers(
    folder: Path, every: int, names: Sequence[str], store: RowStore, count: int | None
) -> dict[str, dict[str, list[Row]]]:
    """Return the rows of each condition and detector with the maps of every k-th photo."""
    data, conditions = (
        open_dataset(folder),
        CONDITIONS if every == min(EVERY) else {"as it is": CONDITIONS["as it is"]},
    )
    photos, tests = data.frame_names("train"), data.frame_names("test")[:count]
    found: dict[str, dict[str, list[Row]]] = {c: {name: [] for name in names} for c in conditions}
    for first in (0, every // 2):
        maps = Maps(data, photos[first::every])
        for place, test in enumerate(tests):
            for condition, change in conditions.items():
                for name in in_turn(names, place):

                    def make(name: str = name, change: Any = change, test: str = test, maps: Maps = maps) -> Row:
                        (view,) = map(without_depth, data.views("test", [test]))
                        matcher = maps[name]
                        return localize(matcher, detector(name), replace(view, frame=change(view.frame)))

                    row = store.get([folder.name, every, first, condition, name, test], make)
                    found[condition][name].append(row)
    return found


def detection(folder: Path, names: Sequence[str], store: RowStore, count: int | None) -> dict[str, list[Row]]:
    """Return the CPU times of each detector on images of 640x480 pixels."""
    data = open_dataset(folder)
    found: dict[str, list[Row]] = {name: [] for name in names}
    for place, test in enumerate(data.frame_names("test")[:count]):
        for name in in_turn(names, place):

            def make(name: str = name, test: str = test) -> Row:
                frame, times = data.views("test", [test])[0].frame, list[float]()
                rgb = resize(frame, 640 / frame.intrinsics.width).rgb[:480].contiguous()
                features = detector(name)
                for _ in range(ANSWERS):
                    began = time.process_time()
                    keypoints = features(rgb)
                    times.append(time.process_time() - began)
                return {"cpu_seconds": min(times), "keypoints": len(keypoints)}

            found[name].append(store.get([folder.name, "VGA", name, test], make))
    return found


def summary(rows: Sequence[Row], base: Sequence[Row]) -> dict[str, Any]:
    """Return successes (with Wilson's 95 % interval), median errors, judgement and times, also relative to those of ``base``."""
    every, judged = rates(rows), judgement(rows)
    interval = {name: every.pop(name) for name in (RIGHT, STRICT)}
    return {
        "n": len(rows),
        "right": interval[RIGHT]["successes"],
        "right_interval": [interval[RIGHT]["low"], interval[RIGHT]["high"]],
        "strict": interval[STRICT]["successes"],
        **every,
        "accepted": judged["converged"],
        "accepted_but_wrong": judged["silent"],
        "median_cpu_seconds": cpu_seconds(rows)["median_cpu_seconds"],
        "times_slower": times_slower(rows, base),
    }


def in_succession(first: Sequence[Row], second: Sequence[Row]) -> list[Row]:
    """Return the answers of one detector, and of another where those are not accepted, with the time of both."""
    return [
        a if a["converged"] else b | {"cpu_seconds": a["cpu_seconds"] + b["cpu_seconds"]}
        for a, b in zip(first, second, strict=True)
    ]


def line(cell: dict[str, Any]) -> str:
    """Return a summary as a line of a table."""
    translation, rotation = (cell[f"median_{part}"] or float("nan") for part in ("translation", "rotation_deg"))
    return (
        f"n {cell['n']:3}  right {cell['right']:3}  strict {cell['strict']:3}  accepted {cell['accepted']:3}"
        f"  wrong {cell['accepted_but_wrong']:2}  median {translation:.4f} {rotation:.3f} deg"
        f"  {cell['median_cpu_seconds']:.3f} s  x {cell['times_slower']:.2f}"
    )


def scene_results(
    folder: Path, every: Sequence[int], names: Sequence[str], store: RowStore, count: int | None
) -> dict[str, Any]:
    """Return the summaries of one dataset, by number of photos and condition, and by detector."""
    result: dict[str, Any] = {}
    base = names[0]
    for k in every:
        for condition, rows in answers(folder, k, names, store, count).items():
            shown = dict(rows)
            for other in names[1:2]:
                shown[f"{base}, then {other}"] = in_succession(rows[base], rows[other])
                shown[f"{other}, then {base}"] = in_succession(rows[other], rows[base])
            cells = {name: summary(found, rows[base]) for name, found in shown.items()}
            result[f"every {k}, {condition}"] = {
                name: cell if name in rows else {part: cell[part] for part in BRIEFLY} for name, cell in cells.items()
            }
            for name, cell in cells.items():
                print(f"{folder.name:16} {k:2} {condition:18} {name:20} {line(cell)}", flush=True)
    timed = detection(folder, names, store, count)
    result["VGA"] = {
        name: {
            "median_cpu_seconds": cpu_seconds(rows)["median_cpu_seconds"],
            "times_slower": times_slower(rows, timed[base]),
            "median_keypoints": statistics.median(row["keypoints"] for row in rows),
        }
        for name, rows in timed.items()
    }
    print(folder.name, result["VGA"])
    return result


def main() -> None:
    arguments = parser(__doc__, "detectors")
    arguments.add_argument("data", nargs="+", type=Path, metavar="DATA", help="folder of a dataset")
    arguments.add_argument("--detectors", nargs="+", default=["sift", "xfeat", "sift-xfeat", ONE_GRID], metavar="NAME")
    arguments.add_argument("--every", nargs="+", type=int, default=list(EVERY), metavar="K")
    arguments.add_argument("--frames", type=int, help="test frames of each dataset (default: all)")
    given = arguments.parse_args()
    one_thread()
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        found = {
            folder.name: scene_results(folder, given.every, given.detectors, store, given.frames)
            for folder in given.data
        }
    if tuple(given.every) == EVERY and given.frames is None:
        record(given.name, found)


if __name__ == "__main__":
    main()
