"""The benefit of estimating the camera's motion while its rows were exposed.

    python benchmarks/rolling_shutter.py MAP:DATA [MAP:DATA ...] [--degrees 0 0.5 2] [--frames 40] [--tuning-frames]

Test frames, as images without depth, are localized by landmarks alone: once with the motion where keypoints show one, and once
under the assumption of a still camera. The images are used as they are, and with the rolling shutter of a camera that turns by
each number of ``--degrees`` (``evaluation.faults``). Records the median errors, how many true poses lie inside the 95 % bound
of the covariance, how many images show a motion, and the CPU time. Frames whose index in the test split is 1 modulo 5 are for
tuning and left out; ``--tuning-frames`` takes only those.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from scipy.stats import chi2
from torch import Generator

from bidnerf_core import load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.faults.camera import rolling_shutter
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.frames.frame import View
from bidnerf_core.io.json import to_plain
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmarks import propose
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.results.errors import normalized_error_squared, pose_error, success_rate

RESULTS = Path(__file__).resolve().parent / "results"
BOUND = float(chi2.ppf(0.95, 6))
WAYS = {"with motion": True, "taken as still": False}


def summary(answers: Sequence[tuple[LandmarkPose, View, float]], tried: int) -> dict[str, Any]:
    """Return the statistics of answers, each of which is the pose found, the view, and the CPU seconds taken."""
    errors = [pose_error(found.T_world_camera, view.T_ref_camera) for found, view, _ in answers]
    squared = [
        normalized_error_squared(found.T_world_camera, view.T_ref_camera, found.full_covariance)
        for found, view, _ in answers
    ]
    inside = sum(float(value) <= BOUND for value in squared)
    return {
        "tried": tried,
        "found": len(answers),
        "median_translation": median(float(error.translation) for error in errors),
        "median_rotation_deg": median(float(error.rotation_deg) for error in errors),
        "inside_95": to_plain(success_rate(inside, len(answers))),
        "show_a_motion": sum(found.has_motion for found, _, _ in answers),
        "median_cpu_seconds": median(seconds for _, _, seconds in answers),
    }


def compared(matcher: LandmarkMatcher, views: Sequence[View], degrees: float) -> dict[str, Any]:
    """Localize each view both ways, in turn, and return the statistics of each way."""
    answers: dict[str, list[tuple[LandmarkPose, View, float]]] = {way: [] for way in WAYS}
    for number, view in enumerate(views):
        frame = replace(view.frame, depth=None)
        if degrees:
            frame = rolling_shutter(frame, degrees, Generator().manual_seed(number))
        for way, moving in WAYS.items():
            began = time.process_time()
            found = propose(matcher, [replace(view, frame=frame)], moving=moving)
            if found is not None:
                answers[way].append((found, view, time.process_time() - began))
    return {way: summary(found, len(views)) for way, found in answers.items() if found}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pairs", nargs="+", metavar="MAP:DATA")
    parser.add_argument("--degrees", nargs="+", type=float, default=[0.0, 0.5, 2.0])
    parser.add_argument("--frames", type=int, default=40, help="frames of each scene, at most")
    parser.add_argument("--tuning-frames", action="store_true")
    parser.add_argument("--name", default="rolling_shutter", help="of the record")
    given = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {}
    for pair in given.pairs:
        map_folder, data = pair.split(":", 1)
        stored = load_map(Path(map_folder))
        if stored.landmarks is None:
            raise InputError(f"{map_folder}: a map without landmarks, expected one that was baked")
        dataset = open_dataset(data, stored.bounds.background)
        names = [
            name
            for number, name in enumerate(dataset.frame_names("test"))
            if (number % 5 == 1) == given.tuning_frames
        ]
        count = min(given.frames, len(names))
        views = dataset.views("test", [names[i * len(names) // count] for i in range(count)])
        matcher = LandmarkMatcher(stored.landmarks)
        scene = Path(data).name
        results[scene] = {f"{degrees:g}": compared(matcher, views, degrees) for degrees in given.degrees}
        print(scene, results[scene], flush=True)
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))


if __name__ == "__main__":
    main()
