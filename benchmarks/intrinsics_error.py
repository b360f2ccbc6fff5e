"""The effect on poses of a focal length that is wrong by a few percent.

    python benchmarks/intrinsics_error.py --map MAP [MAP ...] --data DATA [DATA ...] [--frames 8] [--name intrinsics_error]

Method ``auto`` localizes test frames without a start, with measured depth and without it, from cameras whose focal lengths
are multiplied by each of ``FACTORS``. Errors are those of the camera's position and rotation.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bidnerf_core import Frame, Localizer, View, load_map
from bidnerf_core.datasets import open_dataset
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.results.errors import pose_error

FACTORS = (0.9, 0.95, 0.98, 0.99, 1.0, 1.01, 1.02, 1.05, 1.1)
NEAR = (0.05, 5.0)  # metres and degrees within which an answer counts as right


def zoomed(frame: Frame, factor: float, depth: bool) -> Frame:
    """Return the frame with ``factor`` times its focal length in the stated intrinsics."""
    camera = frame.intrinsics
    wrong = dataclasses.replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    return dataclasses.replace(frame, intrinsics=wrong, depth=frame.depth if depth else None)


def summary(localizer: Localizer, views: Sequence[View], factor: float, depth: bool) -> dict[str, Any]:
    """Localize all views with intrinsics that are wrong by one factor."""
    found = [localizer(zoomed(view.frame, factor, depth)) for view in views]
    errors = [pose_error(f.T_world_camera, v.T_ref_camera) for f, v in zip(found, views, strict=True)]
    metres, degrees = ([float(getattr(e, what)) for e in errors] for what in ("translation", "rotation_deg"))
    right = [m <= NEAR[0] and d <= NEAR[1] for m, d in zip(metres, degrees, strict=True)]
    return {
        "factor": factor,
        "measured depth": depth,
        "frames": len(views),
        "median translation": statistics.median(metres),
        "median rotation_deg": statistics.median(degrees),
        "within 5deg 0.05": sum(right),
        "converged": sum(f.converged for f in found),
        "outcomes": [str(f.outcome) for f in found],
    }


def measured(folder: Path, data: Path, frames: int) -> list[dict[str, Any]]:
    """Return the summaries of one map, on test frames evenly spaced over the split."""
    stored = load_map(folder)
    localizer, dataset = Localizer(stored), open_dataset(data, stored.bounds.background)
    names = dataset.frame_names("test")
    views = dataset.views("test", names[:: max(1, len(names) // frames)][:frames])
    rows = []
    for depth in (True, False):
        for factor in FACTORS:
            rows.append(summary(localizer, views, factor, depth))
            print(folder.name, json.dumps(rows[-1]), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--map", type=Path, nargs="+", required=True)
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="dataset of each map")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--name", default="intrinsics_error")
    given = parser.parse_args()
    results = {
        folder.name: measured(folder, data, given.frames)
        for folder, data in zip(given.map, given.data, strict=True)
    }
    print(write_record(Path(__file__).parent / "results" / f"{given.name}.json", results, 0))


if __name__ == "__main__":
    main()
