"""What maps cost: training aside, their surface, their landmarks, and a search among as many landmarks as a house has.

    python benchmarks/map_cost.py MAP:DATA [MAP:DATA ...] [--part surface landmarks scale] [--landmarks 1000000]

- ``surface``: time, memory and disk of ``bidnerf bake`` on a copy of the map without its surface, as a process of one thread;
- ``landmarks``: time and memory to build landmarks from the training images, which are in memory already, in a process of
  their own;
- ``scale``: time per query and memory of the search by landmarks among more and more of them, in turn. The others are copies of the
  scene's next to it, whose descriptors have their channels in another order: as distinctive as the scene, but unlike it.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from _lab import Scene, one_thread, parser, record, without_depth

from bidnerf_core import SE3, View, load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import forget_peak_memory, peak_memory_bytes
from bidnerf_core.localization import LandmarkMatcher, Loop
from bidnerf_core.mapping import LandmarkMap, build_landmarks, concatenated
from bidnerf_core.results import pose_error, success_rate

# The child measures itself: the child's peak as reported to the parent includes the parent's own.
MAIN = """
import json, sys, time
from bidnerf_core.cli import main
from bidnerf_core.evaluation import peak_memory_bytes

status = main(sys.argv[1:])
print(json.dumps([time.process_time(), peak_memory_bytes()]))
sys.exit(status)
"""


def baked(scene: Scene) -> dict[str, Any]:
    """Bake a copy of a map, and return the cost."""
    with TemporaryDirectory() as folder:
        copy = Path(shutil.copytree(scene.folder, Path(folder) / scene.folder.name))
        if scene.map.info.surface is not None:
            (copy / str(scene.map.info.surface)).unlink(missing_ok=True)
        before, began = size(copy), time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", MAIN, "bake", str(copy), "--data", str(scene.data)],
            env=os.environ | {"OMP_NUM_THREADS": "1"}, stdout=subprocess.PIPE, check=True, text=True,
        )  # fmt: skip
        seconds = time.perf_counter() - began
        processor_seconds, peak = json.loads(done.stdout.splitlines()[-1])
        surface = load_map(copy).surface
        assert surface is not None
        return {
            "seconds, import of torch included": seconds,
            "cpu_seconds": processor_seconds,
            "peak_resident_MiB": peak / 2**20,
            "added_on_disk_MiB": (size(copy) - before) / 2**20,
            "surfels": len(surface.surfels),
            "cell_metres": surface.cell,
            "keyframes": len(surface.keyframes),
        }


def size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def built(data: Path) -> dict[str, Any]:
    """Build the landmarks of a dataset, and return the cost."""
    one_thread()
    views = open_dataset(data).views("train")
    forget_peak_memory()
    before = peak_memory_bytes()
    began, processor = time.perf_counter(), time.process_time()
    landmarks = build_landmarks(views, report=print)
    seconds, processor_seconds = time.perf_counter() - began, time.process_time() - processor
    return {
        "images": len(views),
        "pixels": list(views[0].frame.rgb.shape[1::-1]),
        "landmarks": len(landmarks),
        "megabytes": landmarks.megabytes,
        "seconds": seconds,
        "cpu_seconds": processor_seconds,
        "peak_resident_MiB": peak_memory_bytes() / 2**20,
        "resident_before_MiB": before / 2**20,
    }


def house(scene: LandmarkMap, count: int) -> LandmarkMap:
    """Return ``count`` landmarks: those of ``scene`` and of its copies, in a row along x."""
    extent = float((scene.positions.amax(0) - scene.positions.amin(0))[0])
    parts, generator = [scene], torch.Generator().manual_seed(0)
    while sum(map(len, parts)) < count:
        order = torch.randperm(scene.descriptors.shape[1], generator=generator)
        shift = torch.tensor([1.5 * extent * len(parts), 0.0, 0.0])
        moved = {"positions": scene.positions + shift, "descriptors": scene.descriptors[:, order]}
        parts.append(replace(scene, **moved))
    whole = concatenated(parts)
    return whole[torch.arange(min(max(count, len(scene)), len(whole)))]


def searched(scene: LandmarkMap, sizes: Sequence[int], views: Sequence[View]) -> list[dict[str, Any]]:
    """Localize images of the scene by landmarks alone, with each number of landmarks in turn; return successes and cost."""
    rows, matchers = [], []
    for size in sizes:
        landmarks = house(scene, size)
        began = time.process_time()
        matchers.append(LandmarkMatcher(landmarks))
        rows.append({
            "landmarks": len(landmarks),
            "megabytes": landmarks.megabytes,
            "index_cpu_seconds": time.process_time() - began,
            "peak_resident_GiB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        })  # fmt: skip
    seconds: list[list[float]] = [[] for _ in sizes]
    right = [0] * len(sizes)
    Loop(
        [View(without_depth(views[0]).frame, SE3.identity())], matchers[0]
    )()  # the first query loads libraries
    for view in views:
        query = View(without_depth(view).frame, SE3.identity())
        for number, matcher in enumerate(matchers):
            began = time.process_time()
            found = Loop([query], matcher)()
            seconds[number].append(time.process_time() - began)
            if found is not None and found.verdict.accepted:
                error = pose_error(found.T_world_rig, view.T_ref_camera)
                right[number] += bool(error.translation < 0.05 and error.rotation_deg < 5)
    for row, taken, count in zip(rows, seconds, right, strict=True):
        row["right"] = asdict(success_rate(count, len(views)))
        row["median_cpu_seconds"], row["slowest_cpu_seconds"] = statistics.median(taken), max(taken)
    return rows


def main() -> None:
    arguments = parser(__doc__, "map_cost", scenes=True)
    parts = ("surface", "landmarks", "scale")
    arguments.add_argument("--part", nargs="+", choices=parts, default=list(parts))
    arguments.add_argument("--landmarks", type=int, default=10**6, help="in the largest house")
    given = arguments.parse_args()
    one_thread()
    results: dict[str, Any] = {}
    for scene in map(Scene.open, given.scenes):
        found = results.setdefault(scene.name, {})
        if "surface" in given.part:
            found["surface"] = baked(scene)
        if "landmarks" in given.part:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                found["landmarks"] = pool.submit(built, scene.data).result()
        if "scale" in given.part:
            known = scene.map.landmarks
            if known is None:
                raise InputError(f"{scene.folder}: holds no landmarks; 'bidnerf bake --data' makes them")
            views = scene.views(given.tuning_frames, given.frames or 15)
            sizes = (len(known), 10**5, given.landmarks)
            found["scale"] = searched(known, sizes, views)
        print(scene.name, json.dumps(found, indent=1), flush=True)
    record(given.name, results)


if __name__ == "__main__":
    main()
