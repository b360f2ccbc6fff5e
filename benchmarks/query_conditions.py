r"""Localization by ``auto`` of images unlike the map's: other resolutions and lenses, JPEG, an unknown focal length, a rig.

    python benchmarks/query_conditions.py MAP:DATA [MAP:DATA ...] [--frames 12]

No start and no depth is given. The longer focal lengths are stated correctly: these are images from other cameras. Frames
whose index in the test split is 1 modulo 5 are left out, since settings were tuned on them. A rig consists of a frame and the
two test frames before it, with their true relative poses. Everything runs on one thread; finished answers are kept, so that an
interrupted run resumes where it stopped.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from bidnerf_core import SE3, Frame, Localizer, View, load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.faults import faulty
from bidnerf_core.evaluation.json_lines import RowStore
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.results.errors import pose_error, success_rate

RESULTS = Path(__file__).resolve().parent / "results"
WRONG_FOCAL = 1.1
"""Factor on a focal length that is declared as approximate."""


def resized(frame: Frame, factor: float) -> Frame:
    """Return the image at another resolution, with the matching camera."""
    camera = frame.intrinsics.scaled(factor)
    kind = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    rgb = cv2.resize(frame.rgb.numpy(), (camera.width, camera.height), interpolation=kind)
    return replace(frame, rgb=torch.from_numpy(rgb).clamp(0, 1), intrinsics=camera, alpha=None, depth=None)


def zoomed(frame: Frame, factor: float) -> Frame:
    """Return the middle of the image at the full size, as seen with ``factor`` times the focal length."""
    camera = frame.intrinsics
    width, height = round(camera.width / factor), round(camera.height / factor)
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    rgb = np.ascontiguousarray(frame.rgb.numpy()[top : top + height, left : left + width])
    part = replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=width, height=height)
    rgb = cv2.resize(rgb, (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    whole = part.resized(camera.width, camera.height)
    return replace(frame, rgb=torch.from_numpy(rgb).clamp(0, 1), intrinsics=whole, alpha=None, depth=None)


def of_unknown_focal(frame: Frame) -> Frame:
    """Return the image with a focal length that is 10 % too long and declared as approximate."""
    camera = frame.intrinsics
    wrong = replace(camera, fx=camera.fx * WRONG_FOCAL, fy=camera.fy * WRONG_FOCAL)
    return replace(frame, intrinsics=wrong, focal_is_approximate=True)


def compressed(frame: Frame) -> Frame:
    """Return the image after lossy compression."""
    return faulty(View(frame, SE3.identity()), "jpeg:30", 0).frame


CONDITIONS: dict[str, Callable[[Frame], Frame]] = {
    "as it is": lambda frame: frame,
    "half resolution": partial(resized, factor=0.5),
    "double resolution": partial(resized, factor=2.0),
    "focal length 2 % longer": partial(zoomed, factor=1.02),
    "focal length 4 % longer": partial(zoomed, factor=1.04),
    "focal length 43 % longer": partial(zoomed, factor=1 / 0.7),
    "JPEG quality 30": compressed,
    "unknown focal length": of_unknown_focal,
}
RIG = "rig of three frames"


def answer(localizer: Localizer, views: Sequence[View], condition: str) -> dict[str, Any]:
    """Localize the last view, alone or as part of a rig, and compare the pose with the true one."""
    without = [replace(view, frame=replace(view.frame, depth=None)) for view in views]
    query = without if condition == RIG else CONDITIONS[condition](without[-1].frame)
    began = time.process_time()
    found = localizer(query)
    seconds = time.process_time() - began
    error = pose_error(found.T_world_camera, views[-1].T_ref_camera)
    return {
        "translation": float(error.translation), "rotation_deg": float(error.rotation_deg),
        "converged": found.converged, "outcome": str(found.outcome), "focal_factor": found.focal_factor,
        "cpu_seconds": seconds,
    }  # fmt: skip


def summary(rows: Sequence[dict[str, Any]], condition: str) -> dict[str, Any]:
    """Return successes with Wilson intervals, median errors, and how well the answers judge themselves."""
    right = [r["translation"] < 0.05 and r["rotation_deg"] < 5 for r in rows]
    strict = [r["translation"] < 0.02 and r["rotation_deg"] < 1 for r in rows]
    pairs = [(r["converged"], good) for r, good in zip(rows, right, strict=True)]
    found = {
        "5deg 0.05": asdict(success_rate(sum(right), len(rows))),
        "1deg 0.02": asdict(success_rate(sum(strict), len(rows))),
        "median_translation": statistics.median(r["translation"] for r in rows),
        "median_rotation_deg": statistics.median(r["rotation_deg"] for r in rows),
        "accepted_but_wrong": sum(said and not good for said, good in pairs),
        "right_but_rejected": sum(good and not said for said, good in pairs),
        "median_cpu_seconds": statistics.median(r["cpu_seconds"] for r in rows),
    }
    if condition == "unknown focal length":
        errors = [abs(r["focal_factor"] * WRONG_FOCAL - 1) for r in rows]
        found["median_focal_error"] = statistics.median(errors)
        found["largest_focal_error"] = max(errors)
    return found


def scene(folder: Path, data: Path, count: int, store: RowStore) -> dict[str, Any]:
    """Try all conditions on one scene."""
    stored = load_map(folder)
    dataset, localizer = open_dataset(data, stored.bounds.background), Localizer(stored, "auto")
    names = dataset.frame_names("test")
    chosen = [i for i in range(2, len(names)) if i % 5 != 1][:count]
    found = {}
    for condition in (*CONDITIONS, RIG):
        rows = []
        for i in chosen:
            views = dataset.views("test", names[i - 2 : i + 1])
            key = [data.name, stored.info.weights, str(stored.info.landmarks), condition, names[i]]
            rows.append(store.get(key, partial(answer, localizer, views, condition)))
        s = found[condition] = summary(rows, condition)
        print(
            f"{data.name:16} {condition:22} n {len(rows)}: {s['5deg 0.05']['successes']}, {s['1deg 0.02']['successes']},"
            f" median {s['median_translation']:.4f} {s['median_rotation_deg']:.3f} deg, accepted but wrong"
            f" {s['accepted_but_wrong']}, right but rejected {s['right_but_rejected']},"
            f" focal error {s.get('median_focal_error', 0):.4f}, CPU {s['median_cpu_seconds']:.2f} s",
            flush=True,
        )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", help="MAP:DATA")
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--name", default="query_conditions", help="of the record")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    kept = RESULTS / f"{given.name}.partial.jsonl"
    with RowStore(kept) as store:
        results = {}
        for pair in given.scenes:
            folder, data = map(Path, pair.split(":"))
            results[data.name] = scene(folder, data, given.frames, store)
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))
    kept.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
