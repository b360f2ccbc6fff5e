"""Localization by landmarks alone: success, errors, calibration of the covariance, time by stage, memory.

    python benchmarks/landmarks.py --data DATA [--scenes phone_doll ...] [--depth] [--seeds 2] [--name landmarks]

DATA is the folder that holds the scenes. Landmarks are built from the photos of the training split; the frames of the
test split are localized one by one without a start. Of ``iphone_corridor``, a folder as "3D Scanner App" exports it, every
eighth photo is a query. ``--depth`` lets a query have its measured depth. One thread, unless --threads says otherwise.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as iio
import torch
from scipy.stats import chi2

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.memory import peak_memory_bytes
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.frames import Frame, View
from bidnerf_core.localization.search.landmarks import LandmarkPose, propose
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.mapping.landmark_building import build_landmarks
from bidnerf_core.se3 import SE3

RESULTS = Path(__file__).parent / "results"
SCENES = ("phone_doll", "iphone_corridor", "tum_fr1_xyz", "room_living", "blender_lego")
SIZE = (480, 360)
"""Photos of the scanner are shrunk to that."""
EVERY = 8
"""One photo of so many of the scanner's is a query."""
FAR, CONFIDENT = 5.0, 2
"""Metres beyond which its depth is dropped, and the confidence that it needs."""
INSIDE = float(chi2.ppf(0.95, 6))


def split(folder: Path) -> tuple[list[View], list[View]]:
    """Training views and queries."""
    if (folder / "frame_00000.json").exists():
        views = [scanned(path) for path in sorted(folder.glob("frame_*.jpg"))]
        held_out = set(range(EVERY - 1, len(views), EVERY))
        return [v for i, v in enumerate(views) if i not in held_out], [views[i] for i in sorted(held_out)]
    dataset = open_dataset(folder)
    return dataset.views("train"), dataset.views("test")


def scanned(photo: Path) -> View:
    """A photo of "3D Scanner App": ARKit's pose has OpenGL axes; intrinsics are row by row."""
    record = json.loads(photo.with_suffix(".json").read_text())
    image = iio.imread(photo)
    x, y = SIZE[0] / image.shape[1], SIZE[1] / image.shape[0]
    small = cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA)
    fx, _, cx, _, fy, cy, *_ = record["intrinsics"]
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    pose = torch.tensor(record["cameraPoseARFrame"], dtype=torch.float64).reshape(4, 4) @ flip
    intrinsics = Intrinsics(fx * x, fy * y, cx * x, cy * y, *SIZE)
    rgb = torch.from_numpy(small).float() / 255
    return View(Frame(photo.stem, rgb, intrinsics, scanned_depth(photo)), SE3.from_matrix(pose).normalized())


def scanned_depth(photo: Path) -> torch.Tensor:
    """Metres, where the scanner is sure."""
    number = photo.stem.removeprefix("frame_")
    depth = iio.imread(photo.with_name(f"depth_{number}.png")).astype("float32") / 1000
    sure = iio.imread(photo.with_name(f"conf_{number}.png")) >= CONFIDENT
    depth[~sure | (depth > FAR)] = 0
    return torch.from_numpy(cv2.resize(depth, SIZE, interpolation=cv2.INTER_NEAREST))


def without_depth(view: View) -> View:
    frame = view.frame
    return View(Frame(frame.name, frame.rgb, frame.intrinsics), view.T_ref_camera)


def trial(matcher: LandmarkMatcher, query: View, seeds: int) -> dict[str, Any]:
    """One frame, with its truth hidden; further seeds tell how much the answer depends on them."""
    hidden = [View(query.frame, SE3.identity())]
    began = time.perf_counter()
    found = propose(matcher, hidden)
    seconds = time.perf_counter() - began
    row: dict[str, Any] = {"frame": query.frame.name, "seconds": seconds, "found": found is not None}
    if found is None:
        return row | {"translation": math.inf, "rotation_deg": math.inf}
    others = [propose(matcher, hidden, seed=seed) for seed in range(1, seeds)]
    moved = [float((o.T_world_camera.inverse() @ found.T_world_camera).log()[:3].norm()) for o in others if o]
    return row | judged(found, query.T_ref_camera) | {"seed_spread": max(moved, default=None)}


def judged(found: LandmarkPose, truth: SE3) -> dict[str, Any]:
    error = (found.T_world_camera.inverse() @ truth).log()
    tiny = 1e-14 * torch.eye(6, dtype=torch.float64)
    return {
        "translation": float(torch.linalg.vector_norm(found.T_world_camera.translation - truth.translation)),
        "rotation_deg": math.degrees(float(torch.linalg.vector_norm(error[3:]))),
        "inside": float(error @ torch.linalg.solve(found.covariance + tiny, error)) <= INSIDE,
        "inside_with_map": float(error @ torch.linalg.solve(found.map_covariance + tiny, error)) <= INSIDE,
        "matches": found.matches,
        "agreeing": found.agreeing,
        "correspondences": len(found.correspondences),
        "chance": found.chance,
        "log10_nfa": found.log10_nfa,
        "noise": found.noise,
        "stages": found.seconds,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    def within(metres: float, degrees: float) -> int:
        return sum(row["translation"] <= metres and row["rotation_deg"] <= degrees for row in rows)

    found = [row for row in rows if row["found"]]
    spread = [row["seed_spread"] / row["translation"] for row in found if row.get("seed_spread") is not None]
    return {
        "frames": len(rows),
        "within 5 deg .05": within(0.05, 5),
        "within 1 deg .02": within(0.02, 1),
        "median translation": statistics.median(row["translation"] for row in rows),
        "median rotation_deg": statistics.median(row["rotation_deg"] for row in rows),
        "inside 95 %": sum(row["inside"] for row in found) / max(1, len(found)),
        "inside 95 %, with the map's poses": sum(row["inside_with_map"] for row in found)
        / max(1, len(found)),
        "median seconds": statistics.median(row["seconds"] for row in rows),
        "slowest seconds": max(row["seconds"] for row in rows),
        "stages, median seconds": {
            stage: statistics.median(row["stages"][stage] for row in found)
            for stage in (found[0]["stages"] if found else {})
        },
        "spread over seeds as a share of the error, median": statistics.median(spread) if spread else None,
    }


def scene(folder: Path, depth: bool, seeds: int) -> dict[str, Any]:
    training, queries = split(folder)
    queries = queries if depth else [without_depth(view) for view in queries]
    began, cpu = time.perf_counter(), time.process_time()
    landmarks = build_landmarks(training, report=print)
    built, built_cpu = time.perf_counter() - began, time.process_time() - cpu
    began = time.perf_counter()
    matcher = LandmarkMatcher(landmarks)
    indexed = time.perf_counter() - began
    rows = [trial(matcher, view, seeds) for view in queries]
    return {
        "images": len(training),
        "landmarks": len(landmarks),
        "megabytes": landmarks.megabytes,
        "build_seconds": built,
        "build_cpu_seconds": built_cpu,
        "index_seconds": indexed,
        **summary(rows),
        "peak_resident_MiB": peak_memory_bytes() / 2**20,
        "trials": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--depth", action="store_true")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--name", default="landmarks")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    cv2.setNumThreads(given.threads)
    results = {}
    for name in given.scenes:
        results[name] = scene(given.data / name, given.depth, given.seeds)
        print(
            name, json.dumps({k: v for k, v in results[name].items() if k != "trials"}, indent=1), flush=True
        )
    print(write_record(RESULTS / f"{given.name}.json", {"depth": given.depth, "scenes": results}, 0))


if __name__ == "__main__":
    main()
