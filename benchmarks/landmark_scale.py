r"""Scaling of the search by landmarks: time per query and memory, from one scene to a house of a million landmarks.

    python benchmarks/landmark_scale.py MAP DATA --landmarks 1000000

The house consists of the scene and of copies next to it whose descriptors have their channels in another order: each looks as
distinctive as the scene, but unlike it. Test images of the scene are localized by landmarks alone, without depth and without a
start, among more and more copies; frames whose index in the split is 1 modulo 5 are left out.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import torch

from bidnerf_core import SE3, View, load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.localization.acceptance import landmark_verdict
from bidnerf_core.localization.search.landmarks import propose
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.mapping.landmarks import LandmarkMap, concatenated
from bidnerf_core.results.errors import pose_error, success_rate

RESULTS = Path(__file__).resolve().parent / "results"


def house(scene: LandmarkMap, count: int) -> LandmarkMap:
    """Return ``count`` landmarks: those of ``scene`` and of its copies, in a row along x."""
    extent = float((scene.positions.amax(0) - scene.positions.amin(0))[0])
    parts, generator = [scene], torch.Generator().manual_seed(0)
    while sum(map(len, parts)) < count:
        order = torch.randperm(scene.descriptors.shape[1], generator=generator)
        shift = torch.tensor([1.5 * extent * len(parts), 0.0, 0.0])
        parts.append(
            replace(scene, positions=scene.positions + shift, descriptors=scene.descriptors[:, order])
        )
    whole = concatenated(parts)
    return whole[torch.arange(min(max(count, len(scene)), len(whole)))]


def measured(landmarks: LandmarkMap, views: Sequence[View]) -> dict[str, Any]:
    """Localize images of the scene and return successes, times and memory."""
    began = time.process_time()
    matcher = LandmarkMatcher(landmarks)
    built, seconds, right, stages = time.process_time() - began, [], 0, list[dict[str, float]]()
    for view in views:
        query = View(replace(view.frame, depth=None), SE3.identity())
        began = time.process_time()
        found = propose(matcher, [query])
        seconds.append(time.process_time() - began)
        if found is None or not landmark_verdict(found).accepted:
            continue
        stages.append(found.seconds)
        error = pose_error(found.T_world_camera, view.T_ref_camera)
        right += bool(error.translation < 0.05 and error.rotation_deg < 5)
    return {
        "landmarks": len(landmarks),
        "megabytes": landmarks.megabytes,
        "index_cpu_seconds": built,
        "right": asdict(success_rate(right, len(views))),
        "median_cpu_seconds": statistics.median(seconds),
        "slowest_cpu_seconds": max(seconds),
        "median_wall_seconds_by_stage": {
            name: statistics.median(stage.get(name, 0.0) for stage in stages)
            for name in (stages[0] if stages else {})
        },
        "peak_resident_GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--landmarks", type=int, default=10**6, help="in the largest house")
    parser.add_argument("--frames", type=int, default=15)
    parser.add_argument("--name", default="landmark_scale", help="of the record")
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    stored = load_map(given.map)
    if stored.landmarks is None:
        raise InputError(f"{given.map}: holds no landmarks; 'bidnerf bake --data' makes them")
    dataset = open_dataset(given.data, stored.bounds.background)
    names = [name for i, name in enumerate(dataset.frame_names("test")) if i % 5 != 1][: given.frames]
    views, results = dataset.views("test", names), []
    for count in (len(stored.landmarks), 10**5, given.landmarks):
        results.append(measured(house(stored.landmarks, count), views))
        print({name: value for name, value in results[-1].items() if name != "right"}, results[-1]["right"])
    print(write_record(RESULTS / f"{given.name}.json", {"data": given.data.name, "sizes": results}, seed=0))


if __name__ == "__main__":
    main()
