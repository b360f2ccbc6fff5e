r"""Localization by method ``auto`` with measured depth on the baked surface alone, and the cost of the surface.

    python benchmarks/surface_alone.py MAP:DATA [MAP:DATA ...]

No start is given, and landmarks are not used. Each frame is tried in turn with the surface that the map has (before) and with
one baked anew from the dataset's training views (after); to compare two versions, bake the map's surface with the older one.
Frames whose index in the test split is 1 modulo 5 are left out, since settings were tuned on them; ``--tuning-frames`` takes
only those. Each dataset has a record of its own. Everything runs in one process of one thread.
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
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.frames.frame import View
from bidnerf_core.localization import settings_of
from bidnerf_core.mapping import bake
from bidnerf_core.maps.storage import cameras_of
from bidnerf_core.results.errors import pose_error

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
    """Return successes, median errors, and how often right and wrong answers are accepted."""
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


def measured_views(stored: Map, data: Path) -> list[View]:
    """Return the training views with measured depth."""
    views = open_dataset(data, stored.bounds.background).views("train")
    return [view for view in views if view.frame.has_depth]


def baked(stored: Map, data: Path) -> tuple[Map, dict[str, float]]:
    """Return the map with a surface baked anew, as by ``bidnerf bake``, and the seconds that this took."""
    measured = measured_views(stored, data)
    began, cpu = time.perf_counter(), time.process_time()
    surface = bake(stored.field, stored.bounds, [] if measured else cameras_of(stored.info), measured)
    seconds = {"bake_seconds": time.perf_counter() - began, "bake_cpu_seconds": time.process_time() - cpu}
    return replace(stored, surface=surface), seconds


def described(stored: Map) -> dict[str, Any]:
    """Return the size of a map's surface."""
    surface = stored.surface
    if surface is None:
        raise SystemExit(f"{stored.info.data}: has no surface, expected a baked map")
    return {
        "cell": surface.cell, "cells": list(surface.grid.shape), "surfels": len(surface.surfels),
        "megabytes": surface.bytes / 1e6,
    }  # fmt: skip


def compared(data: Path, tuning: bool, **maps: Map) -> dict[str, dict[str, Any]]:
    """Localize a dataset's test frames with depth on the surfaces of several maps, which take turns."""
    stored = next(iter(maps.values()))
    dataset = open_dataset(data, stored.bounds.background)
    names = [n for i, n in enumerate(dataset.frame_names("test")) if (i % 5 == 1) == tuning]
    views = [view for view in dataset.views("test", names) if view.frame.has_depth]
    settings = settings_of("auto", {"landmarks": False})
    localizers = {what: Localizer(a_map, "auto", settings) for what, a_map in maps.items()}
    rows: dict[str, list[dict[str, Any]]] = {what: [] for what in maps}
    for number, view in enumerate(views):
        order = list(localizers) if number % 2 else list(localizers)[::-1]
        for what in order:
            rows[what].append(localized(localizers[what], view))
    return {what: described(maps[what]) | summary(rows[what]) | {"frames": rows[what]} for what in maps}


def ratio_of_times(rows: dict[str, dict[str, Any]]) -> float:
    """Return the ratio of the time after to the time before, the median over frames."""
    before, after = ([row["cpu_seconds"] for row in rows[what]["frames"]] for what in ("before", "after"))
    return statistics.median(b / a for a, b in zip(before, after, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", help="MAP:DATA")
    parser.add_argument("--tuning-frames", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    for pair in given.scenes:
        folder, data = map(Path, pair.rsplit(":", 1))
        stored = load_map(folder)
        anew, seconds = baked(stored, data)
        found: dict[str, Any] = dict(compared(data, given.tuning_frames, before=stored, after=anew))
        found["after"] |= seconds
        for what, row in found.items():
            print(data.name, what, {k: v for k, v in row.items() if k != "frames"}, flush=True)
        found["cpu_time_after_to_before"] = ratio_of_times(found)
        print(data.name, found["cpu_time_after_to_before"], flush=True)
        if not given.tuning_frames:
            print(write_record(RESULTS / f"surface_alone_{data.name}.json", found, seed=0))


if __name__ == "__main__":
    main()
