"""The benefit of estimating the camera's motion while its rows were exposed.

    python benchmarks/rolling_shutter.py MAP:DATA [MAP:DATA ...] [--degrees 0 0.5 2] [--frames 40]

Test frames, as images without depth, are localized by landmarks alone: once with the motion where keypoints show one, and once
under the assumption of a still camera. The images are used as they are, and with the rolling shutter of a camera that turns by
each number of ``--degrees``. Records the median errors, how many true poses lie inside the 95 % bound of the covariance, how
many images show a motion, and the CPU time.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from statistics import median
from typing import Any

from _lab import Scene, in_turn, one_thread, parser, record, without_depth
from torch import Generator

from bidnerf_core import View
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import rolling_shutter
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import MOVING, LandmarkMatcher, Loop
from bidnerf_core.localization import Answer as Found
from bidnerf_core.results import pose_error, success_rate, within

WAYS = {"with motion": True, "taken as still": False}
Answer = tuple[Found, View, float]
"""The pose found, the view, and the CPU seconds taken."""


def summary(answers: Sequence[Answer], tried: int) -> dict[str, Any]:
    """Return the statistics of answers."""
    errors = [pose_error(found.T_world_rig, view.T_ref_camera) for found, view, _ in answers]
    inside = sum(bool(within(f.T_world_rig, v.T_ref_camera, f.covariance)) for f, v, _ in answers)
    return {
        "tried": tried,
        "found": len(answers),
        "median_translation": median(float(error.translation) for error in errors),
        "median_rotation_deg": median(float(error.rotation_deg) for error in errors),
        "inside_95": asdict(success_rate(inside, len(answers))),
        "show_a_motion": sum(found.explanation.endswith(MOVING) for found, _, _ in answers),
        "median_cpu_seconds": median(seconds for _, _, seconds in answers),
    }


def compared(matcher: LandmarkMatcher, views: Sequence[View], degrees: float) -> dict[str, Any]:
    """Localize each view both ways, in turn, and return the statistics of each way."""
    answers: dict[str, list[Answer]] = {way: [] for way in WAYS}
    for number, view in enumerate(map(without_depth, views)):
        shown = view.frame
        if degrees:
            shown = rolling_shutter(shown, degrees, Generator().manual_seed(number))
        for way in in_turn(list(WAYS), number):
            began = time.process_time()
            found = Loop(
                [replace(view, T_ref_camera=SE3.identity(), frame=shown)], matcher, moving=WAYS[way]
            )()
            if found is not None:
                answers[way].append((found, view, time.process_time() - began))
    return {way: summary(found, len(views)) for way, found in answers.items() if found}


def main() -> None:
    arguments = parser(__doc__, "rolling_shutter", scenes=True)
    arguments.add_argument("--degrees", nargs="+", type=float, default=[0.0, 0.5, 2.0])
    given = arguments.parse_args()
    one_thread()
    results: dict[str, Any] = {}
    for scene in map(Scene.open, given.scenes):
        if scene.map.landmarks is None:
            raise InputError(f"{scene.folder}: a map without landmarks, expected one that was baked")
        matcher, views = LandmarkMatcher(scene.map.landmarks), scene.views(given.tuning_frames, given.frames)
        results[scene.name] = {f"{degrees:g}": compared(matcher, views, degrees) for degrees in given.degrees}
        print(scene.name, results[scene.name], flush=True)
    record(given.name, results)


if __name__ == "__main__":
    main()
