r"""What method ``auto`` finds by measured depth on the baked surface alone, and what the surface costs.

    python benchmarks/surface_alone.py MAP:DATA [MAP:DATA ...] --bake --name surface_alone

No start is given, landmarks are not used. Each map is tried with the surface that it has and, with ``--bake``, with one
baked anew from the dataset's training views. Frames whose index in the test split is 1 modulo 5 are left out, since settings were tuned on them;
``--tuning-frames`` takes those only. One process of one thread.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from bidnerf_core import Localizer, Map, load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.frames import View
from bidnerf_core.localization import settings_of
from bidnerf_core.mapping import bake
from bidnerf_core.storage import cameras_of

RESULTS = Path(__file__).resolve().parent / "results"


def localized(localizer: Localizer, view: View) -> dict[str, Any]:
    """Localize a frame without a start and compare the answer with the true pose."""
    began = time.process_time()
    found = localizer(view.frame)
    seconds = time.process_time() - began
    error = pose_error(found.T_world_camera, view.T_ref_camera)
    return {
        "frame": view.frame.name, "translation": float(error.translation), "rotation_deg": float(error.rotation_deg),
        "outcome": str(found.outcome), "cpu_seconds": seconds,
    }  # fmt: skip


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return successes, median errors, and how often the answers are accepted rightly and wrongly."""
    right = [r["translation"] < 0.05 and r["rotation_deg"] < 5 for r in rows]
    accepted = [r["outcome"] == "converged" for r in rows]
    return {
        "trials": len(rows),
        "5deg 0.05": sum(right),
        "1deg 0.02": sum(r["translation"] < 0.02 and r["rotation_deg"] < 1 for r in rows),
        "accepted": sum(accepted),
        "accepted_but_wrong": sum(a and not good for a, good in zip(accepted, right, strict=True)),
        "median_translation": statistics.median(r["translation"] for r in rows),
        "median_rotation_deg": statistics.median(r["rotation_deg"] for r in rows),
        "median_cpu_seconds": statistics.median(r["cpu_seconds"] for r in rows),
    }


def baked(stored: Map, data: Path) -> tuple[Map, dict[str, float]]:
    """Return the map with a surface baked anew, as ``bidnerf bake`` does it, and the seconds that took."""
    views = open_dataset(data, stored.bounds.background).views("train")
    measured = [view for view in views if view.frame.has_depth]
    began, cpu = time.perf_counter(), time.process_time()
    surface = bake(stored.field, stored.bounds, [] if measured else cameras_of(stored.info), measured)
    seconds = {"bake_seconds": time.perf_counter() - began, "bake_cpu_seconds": time.process_time() - cpu}
    return replace(stored, surface=surface), seconds


def tried(stored: Map, data: Path, tuning: bool) -> dict[str, Any]:
    """Localize a dataset's test frames with depth on the surface of a map."""
    surface = stored.surface
    if surface is None:
        raise SystemExit(f"{stored.info.data}: has no surface, expected a baked map")
    dataset = open_dataset(data, stored.bounds.background)
    names = [n for i, n in enumerate(dataset.frame_names("test")) if (i % 5 == 1) == tuning]
    views = [view for view in dataset.views("test", names) if view.frame.has_depth]
    localizer = Localizer(stored, "auto", settings_of("auto", {"landmarks": False}))
    rows = [localized(localizer, view) for view in views]
    return {
        "cell": surface.cell, "cells": list(surface.grid.shape), "surfels": len(surface.surfels),
        "megabytes": surface.bytes / 1e6, **summary(rows), "frames": rows,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", help="MAP:DATA")
    parser.add_argument("--name", default="surface_alone", help="of the record")
    parser.add_argument("--bake", action="store_true", help="try a surface that is baked anew, too")
    parser.add_argument("--tuning-frames", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {}
    for pair in given.scenes:
        folder, data = map(Path, pair.rsplit(":", 1))
        stored, found = load_map(folder), {}
        found["stored"] = tried(stored, data, given.tuning_frames)
        if given.bake:
            anew, seconds = baked(stored, data)
            found["baked anew"] = seconds | tried(anew, data, given.tuning_frames)
        for what, row in found.items():
            print(data.name, what, {k: v for k, v in row.items() if k != "frames"}, flush=True)
        results[data.name] = found
    if not given.tuning_frames:
        print(write_record(RESULTS / f"{given.name}.json", results, seed=0))


if __name__ == "__main__":
    main()
