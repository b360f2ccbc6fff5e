r"""Contribution of each part of method ``auto``: landmarks, the surface, rendered rays, with and without depth.

    python benchmarks/auto_terms.py MAP:DATA [MAP:DATA ...] --name auto_terms

No start is given. Frames whose index in the test split is 1 modulo 5 are left out, since settings were tuned on them;
``--tuning-frames`` takes only those. Maps need landmarks (``bidnerf train`` and ``bidnerf bake --data`` build them). Everything
runs in one process of one thread; finished frames are kept, so that an interrupted run resumes where it stopped. Without depth,
the surface alone takes many seconds per image; ``--slow`` tries that as well.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from scipy.stats import chi2

from bidnerf_core import Localizer, Map, load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.json_lines import RowStore
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.frames.frame import View
from bidnerf_core.localization import settings_of
from bidnerf_core.results.errors import normalized_error_squared, pose_error, success_rate

RESULTS = Path(__file__).resolve().parent / "results"
VARIANTS: dict[str, dict[str, Any]] = {
    "surface alone": {"landmarks": False},
    "landmarks alone": {"fused_rays": 0},
    "all": {},
}
SLOW = "surface alone"
BOUND = float(chi2.ppf(0.95, 6))
"""Normalised squared error below which nineteen of twenty errors lie if the covariance is right."""


def one_frame(localizer: Localizer, view: View, depth: bool) -> dict[str, Any]:
    """Localize a frame without a start and compare the answer with the true pose."""
    frame = view.frame if depth else replace(view.frame, depth=None)
    began = time.process_time()
    found = localizer(frame)
    seconds = time.process_time() - began
    error = pose_error(found.T_world_camera, view.T_ref_camera)
    inside = None
    if found.covariance is not None:
        squared = normalized_error_squared(found.T_world_camera, view.T_ref_camera, found.covariance)
        inside = bool(squared <= BOUND)
    return {
        "translation": float(error.translation), "rotation_deg": float(error.rotation_deg),
        "outcome": str(found.outcome), "inside_95": inside, "cpu_seconds": seconds,
    }  # fmt: skip


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return successes with Wilson intervals, median errors, and how well the answers judge themselves."""
    right = [r["translation"] < 0.05 and r["rotation_deg"] < 5 for r in rows]
    strict = [r["translation"] < 0.02 and r["rotation_deg"] < 1 for r in rows]
    accepted = [r["outcome"] == "converged" for r in rows]
    pairs = list(zip(accepted, right, strict=True))
    covered = [
        r["inside_95"] for r, a in zip(rows, accepted, strict=True) if a and r["inside_95"] is not None
    ]
    return {
        "5deg 0.05": asdict(success_rate(sum(right), len(rows))),
        "1deg 0.02": asdict(success_rate(sum(strict), len(rows))),
        "median_translation": statistics.median(r["translation"] for r in rows),
        "median_rotation_deg": statistics.median(r["rotation_deg"] for r in rows),
        "accepted": sum(accepted),
        "accepted_but_wrong": sum(a and not good for a, good in pairs),
        "right_but_rejected": sum(good and not a for a, good in pairs),
        "inside_95_of_accepted": f"{sum(covered)} of {len(covered)}",
        "median_cpu_seconds": statistics.median(r["cpu_seconds"] for r in rows),
        "slowest_cpu_seconds": max(r["cpu_seconds"] for r in rows),
    }


def scene(stored: Map, name: str, data: Path, tuning: bool, slow: bool, store: RowStore) -> dict[str, Any]:
    """Try all variants on the frames of one scene, as RGB and, where there is depth, as RGB-D."""
    dataset = open_dataset(data, stored.bounds.background)
    names = [n for i, n in enumerate(dataset.frame_names("test")) if (i % 5 == 1) == tuning]
    views = dataset.views("test", names)
    localizers = {
        label: Localizer(stored, "auto", settings_of("auto", settings))
        for label, settings in VARIANTS.items()
    }
    found: dict[str, Any] = {}
    for depth in (False, True):
        if depth and not any(view.frame.has_depth for view in views):
            continue
        for label, localizer in localizers.items():
            if label == SLOW and not depth and not slow:
                continue
            kind = f"{'RGB-D' if depth else 'RGB'}, {label}"
            rows = []
            for view in views:
                key = [name, stored.info.weights, str(stored.info.landmarks), kind, view.frame.name]
                rows.append(store.get(key, partial(one_frame, localizer, view, depth)))
            found[kind] = summary(rows)
            s = found[kind]
            print(
                f"{name:12} {kind:24} n {len(rows)}: {s['5deg 0.05']['successes']}, {s['1deg 0.02']['successes']}, median"
                f" {s['median_translation']:.4f} {s['median_rotation_deg']:.3f} deg, accepted {s['accepted']},"
                f" wrong of these {s['accepted_but_wrong']}, inside 95 % {s['inside_95_of_accepted']},"
                f" CPU {s['median_cpu_seconds']:.2f} s",
                flush=True,
            )
    return {"landmarks": len(stored.landmarks or ()), "colour_noise": stored.colour_noise, "variants": found}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+", help="MAP:DATA")
    parser.add_argument("--name", default="auto_terms", help="of the record")
    parser.add_argument("--tuning-frames", action="store_true")
    parser.add_argument("--slow", action="store_true", help="try the surface alone without depth, too")
    given = parser.parse_args()
    torch.set_num_threads(1)
    kept = RESULTS / f"{given.name}.partial.jsonl"
    results: dict[str, Any] = {}
    with RowStore(kept) as store:
        for pair in given.scenes:
            folder, data = map(Path, pair.split(":"))
            results[data.name] = scene(
                load_map(folder), data.name, data, given.tuning_frames, given.slow, store
            )
    print(write_record(RESULTS / f"{given.name}.json", results, seed=0))
    kept.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
