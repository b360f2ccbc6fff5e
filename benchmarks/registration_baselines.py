"""Compare method ``auto`` with registration of point clouds, which needs no radiance field, on the same map and frames.

    python benchmarks/registration_baselines.py MAP DATA --name registration_lego

The following are compared alternately, each on one thread, on every frame of the test split:

- ``open3d icp``: FPFH features and RANSAC, then point-to-plane ICP; no start;
- ``open3d coloured icp``: the same, then coloured ICP;
- ``auto``: ours; no start;
- ``gicp``: small_gicp's GICP from the starts of protocol ``bid``, 0.5 off (``--off``);
- ``auto from start``: ours from the same starts;
- ``auto + gicp``: GICP from the answer of ``auto``, which had no start.

The other methods register all pixels that have a depth to the surfels of the map, which ``bidnerf bake`` makes. ``--voxel``
is the value at which tuning begins: 5 cm in rooms, or 2 % of the extent of an object. Voxels, distances and stages are chosen
for each scene on frames whose index in the split is 1 modulo 5, which are not reported. Times begin with the frame in memory
and the map's points, features and trees built.

small_gicp comes with ``pip install '.[eval]'``. Open3D is large and not needed elsewhere: give it its own environment,

    python3.11 -m venv .venv-open3d && .venv-open3d/bin/pip install -c constraints.txt '.[eval]' open3d

Libraries that are not installed are skipped. Finished rows are kept in a ``.jsonl`` next to the record, so that an
interrupted run resumes where it stopped.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # before any library counts the cores

import argparse
import json
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from registration_clouds import Points, map_points, measured_points
from registration_methods import Gicp, Matrix, Open3d, Ransac, Refine, SmallGicp
from registration_tuning import Case, as_pose, cases, tuned_gicp, tuned_open3d

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.json_lines import RowStore
from bidnerf_core.evaluation.protocols import bid_start
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.evaluation.trials import opened
from bidnerf_core.frames.frame import View
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.json import from_plain, to_plain
from bidnerf_core.localization import Localizer
from bidnerf_core.maps.map import Map
from bidnerf_core.results.errors import CRITERIA, pose_error, success_rate

RESULTS = Path(__file__).parent / "results"

OPEN3D: dict[str, type] = {"ransac": Ransac, "icp": Refine, "coloured icp": Refine}
"""The types of the settings, by their names."""

Registration = Callable[[View, int], Matrix]
"""A function from a view and a seed to T_world_camera; the view's own pose serves only to make a start."""


def auto(localizer: Localizer, view: View, start: SE3 | None, seed: int) -> Matrix:
    """Return the answer of method ``auto``."""
    return localizer(view, start, seed=seed).T_world_camera.matrix().numpy()


def start_of(truth: SE3, off: float, seed: int) -> Matrix:
    return bid_start(truth, off, seed).matrix().numpy()


def tuning(stored: Map, views: Sequence[View], voxel: float, off: float, kept: RowStore) -> dict[str, Any]:
    """Return the chosen settings of each library that is installed, by name."""
    points = map_points(stored.surface)
    tries = cases([(measured_points(view.frame), view.T_ref_camera) for view in views])
    chosen: dict[str, Any] = {}
    if find_spec("open3d"):
        plain = kept.get(["tuned", "open3d"], lambda: open3d_settings(points, tries, voxel))
        chosen = {name: from_plain(OPEN3D[name], plain[name], name) for name in OPEN3D}
    if find_spec("small_gicp"):
        given = [start_of(case.truth, off, i) for i, case in enumerate(tries)]
        localizer = Localizer(stored)
        found = [auto(localizer, views[i % len(views)], None, i) for i in range(len(tries))]
        for name, starts in {"gicp": given, "auto + gicp": found}.items():
            plain = kept.get(
                ["tuned", name], partial(gicp_settings, points, tries, starts, voxel, name != "gicp")
            )
            chosen[name] = from_plain(Gicp, plain, name)
    return chosen


def open3d_settings(points: Points, tries: Sequence[Case], voxel: float) -> dict[str, Any]:
    print("tuning Open3D", flush=True)
    tuned = tuned_open3d(Open3d(points), tries, voxel)
    return {name: to_plain(setting) for name, setting in zip(OPEN3D, tuned, strict=True)}


def gicp_settings(
    points: Points, tries: Sequence[Case], starts: Sequence[Matrix], voxel: float, near: bool
) -> dict[str, Any]:
    print("tuning small_gicp", flush=True)
    plain: dict[str, Any] = to_plain(tuned_gicp(SmallGicp(points), tries, starts, voxel, near))
    return plain


def registrations(stored: Map, chosen: dict[str, Any], off: float) -> dict[str, Registration]:
    """Return the registrations by name, with everything computed from the map in advance."""
    points, localizer = map_points(stored.surface), Localizer(stored)
    result: dict[str, Registration] = {
        "auto": lambda view, seed: auto(localizer, view, None, seed),
        "auto from start": lambda view, seed: auto(
            localizer, view, as_pose(start_of(view.T_ref_camera, off, seed)), seed
        ),
    }
    if "ransac" in chosen:
        open3d = Open3d(points)

        def searched(view: View, seed: int, refine: Refine) -> Matrix:
            open3d.seed(seed)
            measured = measured_points(view.frame)
            return open3d.refine(measured, open3d.search(measured, chosen["ransac"]), refine)

        result["open3d icp"] = lambda view, seed: searched(view, seed, chosen["icp"])
        result["open3d coloured icp"] = lambda view, seed: searched(view, seed, chosen["coloured icp"])
    if "gicp" in chosen:
        gicp = SmallGicp(points)
        result["gicp"] = lambda view, seed: gicp.refine(
            measured_points(view.frame), start_of(view.T_ref_camera, off, seed), chosen["gicp"]
        )
        result["auto + gicp"] = lambda view, seed: gicp.refine(
            measured_points(view.frame), auto(localizer, view, None, seed), chosen["auto + gicp"]
        )
    return result


def measured(run: Registration, view: View, seed: int) -> dict[str, Any]:
    began, used = time.perf_counter(), time.process_time()
    T = run(view, seed)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - used
    error = pose_error(as_pose(T), view.T_ref_camera)
    return {
        "translation": float(error.translation),
        "rotation_deg": float(error.rotation_deg),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
    }


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    def column(name: str) -> list[float]:
        return [row[name] for row in rows]

    result: dict[str, Any] = {"n": len(rows)}
    for name in ("5deg 0.05", "1deg 0.02"):
        bar: Any = CRITERIA[name]
        good = [r["translation"] < bar.translation and r["rotation_deg"] < bar.rotation_deg for r in rows]
        result[name] = asdict(success_rate(sum(good), len(rows)))
    for name in ("translation", "rotation_deg", "seconds", "cpu_seconds"):
        result[f"median_{name}"] = statistics.median(column(name))
    return result | {"worst_seconds": max(column("seconds")), "worst_cpu_seconds": max(column("cpu_seconds"))}


def times_slower(rows: dict[str, list[dict[str, Any]]], name: str, clock: str) -> float:
    """Return how many times slower than ``auto`` a method is: the median over the frames, on which both ran in turn."""
    pairs = zip(rows[name], rows["auto"], strict=True)
    return statistics.median(row[clock] / ours[clock] for row, ours in pairs)


def versions() -> dict[str, str | None]:
    found: dict[str, str | None] = {}
    for name in ("open3d", "small_gicp"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
            print(f"{name} is not installed: skipped; see the head of this file")
    return found


def compared(runs: dict[str, Registration], views: Sequence[View], kept: RowStore) -> dict[str, Any]:
    """Return the rows of each method on the frames that settings were not tuned on."""
    names = list(runs)
    for run in runs.values():  # one-time work is not timed
        run(views[1], 0)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in names}
    for place, view in enumerate(views):
        if place % 5 == 1:
            continue
        shift = place % len(names)
        for name in names[shift:] + names[:shift]:
            row = kept.get([name, view.frame.name], lambda n=name, v=view, s=place: measured(runs[n], v, s))
            rows[name].append({"frame": view.frame.name, **row})
        print(".", end="", flush=True)
    print()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("map", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--name", required=True, help="of the record")
    parser.add_argument("--voxel", type=float, default=0.05, help="metres")
    parser.add_argument("--off", type=float, default=0.5, help="size of the starts that are given")
    parser.add_argument("--methods", nargs="+", help="only these, 'auto' among them")
    given = parser.parse_args()
    torch.set_num_threads(1)
    installed = versions()
    stored, dataset = opened(str(given.map), str(given.data))
    if stored.surface is None:
        raise InputError(f"{given.map}: no baked surface, expected one as 'bidnerf bake' makes it")
    views = dataset.views("test")
    with RowStore(RESULTS / f"{given.name}.partial.jsonl") as kept:
        chosen = tuning(stored, views[1::5], given.voxel, given.off, kept)
        runs = registrations(stored, chosen, given.off)
        wanted = given.methods or list(runs)
        rows = compared({name: run for name, run in runs.items() if name in wanted}, views, kept)
    methods = {
        name: summary(found)
        | {f"{clock}_against_auto": times_slower(rows, name, clock) for clock in ("seconds", "cpu_seconds")}
        for name, found in rows.items()
    }
    results = {
        "map": given.map.name,
        "data": given.data.name,
        "versions": installed,
        "start": f"bid:{given.off:g} for gicp and auto from start, none for the others",
        "settings": {name: to_plain(setting) for name, setting in chosen.items()},
        "methods": methods,
        "rows": rows,
    }
    print(write_record(RESULTS / f"{given.name}.json", results, 0))
    print(json.dumps(methods, indent=1))
    kept.path.unlink()


if __name__ == "__main__":
    main()
