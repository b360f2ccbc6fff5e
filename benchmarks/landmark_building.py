"""The cost of building landmarks from photos: time, memory, and size.

    python benchmarks/landmark_building.py DATA [DATA ...] [--threads 1] [--name landmark_building]

Landmarks are built from the images of each dataset's training split, with measured depth where there is any. Reading the
images is not counted. Each dataset has a process of its own, so that its peak of memory is its own.
"""

from __future__ import annotations

import argparse
import json
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import torch

from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.trials import forget_peak_memory, peak_memory_bytes
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.mapping.landmark_building import build_landmarks

RESULTS = Path(__file__).resolve().parent / "results"


def built(data: Path, threads: int) -> dict[str, Any]:
    """Build the landmarks of a dataset, and return the cost."""
    torch.set_num_threads(threads)
    cv2.setNumThreads(threads)
    views = open_dataset(data).views("train")
    forget_peak_memory()
    before = peak_memory_bytes()
    began, cpu = time.perf_counter(), time.process_time()
    landmarks = build_landmarks(views, report=print)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - cpu
    peak = peak_memory_bytes()
    began = time.process_time()
    LandmarkMatcher(landmarks)
    return {
        "images": len(views),
        "pixels": list(views[0].frame.rgb.shape[1::-1]),
        "landmarks": len(landmarks),
        "megabytes": landmarks.megabytes,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "index_cpu_seconds": time.process_time() - began,
        "peak_resident_MiB": peak / 2**20,
        "resident_before_MiB": before / 2**20,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, nargs="+")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--name", default="landmark_building", help="of the record")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    results: dict[str, Any] = {}
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        for data in given.data:
            results[data.name] = pool.submit(built, data, given.threads).result()
            print(data.name, json.dumps(results[data.name], indent=1), flush=True)
    print(write_record(RESULTS / f"{given.name}.json", {"scenes": results}, seed=0))


if __name__ == "__main__":
    main()
