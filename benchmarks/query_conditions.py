r"""Localization by ``auto`` of images unlike the map's: other resolutions and lenses, JPEG, an unknown focal length, a rig.

    python benchmarks/query_conditions.py MAP:DATA [MAP:DATA ...] [--frames 12]

No start and no depth is given. The longer focal lengths are stated correctly: these are images from other cameras. Frames
whose index in the test split is 1 modulo 5 are left out, since settings were tuned on them. A rig consists of a frame and the
two test frames before it, with their true relative poses. Everything runs on one thread; finished answers are kept, so that an
interrupted run resumes where it stopped.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np
import torch
from _lab import (
    RESULTS,
    Row,
    RowStore,
    Scene,
    answer,
    cpu_seconds,
    held_out,
    judgement,
    line,
    one_thread,
    parser,
    rates,
    record,
    without_depth,
)

from bidnerf import SE3, Frame, Localization, Localizer, View
from bidnerf.evaluation import faulty

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
    return frame.replace(intrinsics=wrong, focal_is_approximate=True)


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


def localized(localizer: Localizer, views: Sequence[View], condition: str) -> Row:
    """Localize the last view, alone or as part of a rig, and compare the pose with the true one."""
    shown = [without_depth(view) for view in views]
    focal: list[float] = []

    def localize() -> Localization:
        found = localizer(shown if condition == RIG else CONDITIONS[condition](shown[-1].frame))
        focal.append(found.focal_factor)
        return found

    return answer(localize, views[-1]) | {"focal_factor": focal[0]}


def summary(rows: Sequence[Row], condition: str) -> dict[str, Any]:
    """Return successes with Wilson intervals, median errors, and how well the answers judge themselves."""
    judged = judgement(rows)
    found = rates(rows) | {
        "accepted_but_wrong": judged["silent"],
        "right_but_rejected": judged["right_but_rejected"],
        "median_cpu_seconds": cpu_seconds(rows)["median_cpu_seconds"],
    }
    if condition == "unknown focal length":
        errors = [abs(row["focal_factor"] * WRONG_FOCAL - 1) for row in rows]
        found |= {"median_focal_error": statistics.median(errors), "largest_focal_error": max(errors)}
    return found


def scene_results(scene: Scene, count: int, store: RowStore) -> dict[str, Any]:
    """Try all conditions on one scene."""
    localizer, names = Localizer(scene.map, "auto"), scene.dataset.frame_names("test")
    chosen = [names.index(name) for name in held_out(names) if name not in names[:2]][:count]
    found = {}
    for condition in (*CONDITIONS, RIG):
        rows = []
        for i in chosen:
            views = scene.dataset.views("test", names[i - 2 : i + 1])
            key = [*scene.key, condition, names[i]]
            rows.append(store.get(key, partial(localized, localizer, views, condition)))
        found[condition] = summary(rows, condition)
        print(line(f"{scene.name} {condition}", rows), flush=True)
    return found


def main() -> None:
    given = parser(__doc__, "query_conditions", scenes=True).parse_args()
    one_thread()
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        scenes = map(Scene.open, given.scenes)
        record(given.name, {scene.name: scene_results(scene, given.frames or 12, store) for scene in scenes})


if __name__ == "__main__":
    main()
