r"""What method ``auto`` finds by measured depth on the baked surface alone, for several surfaces of the same map.

    python benchmarks/surface_alone.py MAP[,MAP ...]:DATA [...] --name surface_alone

No start is given, landmarks are not used. Maps of one dataset (first the one to compare with) should differ in their surface
only. Frames whose index in the test split is 1 modulo 5 are left out, since settings were tuned on them;
``--tuning-frames`` takes those only. One process of one thread.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from bidnerf_core import Localizer, load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.frames import View
from bidnerf_core.localization import settings_of

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


def tried(folder: Path, data: Path, tuning: bool) -> dict[str, Any]:
    """Localize a dataset's test frames with depth on the surface of one map."""
    stored = load_map(folder)
    surface = stored.surface
    if surface is None:
        raise SystemExit(f"{folder}: has no surface, expected a baked map")
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
    parser.add_argument("scenes", nargs="+", help="MAP[,MAP ...]:DATA")
    parser.add_argument("--name", default="surface_alone", help="of the record")
    parser.add_argument("--tuning-frames", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {}
    for pair in given.scenes:
        maps, data = pair.rsplit(":", 1)
        for folder in map(Path, maps.split(",")):
            found = tried(folder, Path(data), given.tuning_frames)
            results[f"{Path(data).name}: {folder.parent.name}/{folder.name}"] = found
            print(folder, {key: value for key, value in found.items() if key != "frames"}, flush=True)
    if not given.tuning_frames:
        print(write_record(RESULTS / f"{given.name}.json", results, seed=0))


if __name__ == "__main__":
    main()
