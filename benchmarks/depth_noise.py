r"""The noise estimated from single depth images, as they are and with noise of known size added.

    python benchmarks/depth_noise.py DATA [DATA ...] --frames 10

Evenly spaced test frames are taken from each dataset. Frames whose index in the test split is 1 modulo 5 are left out, since
the estimate was developed on them. Results, for each fault of ``docs/faults.md`` that is tried: the median over the frames of
the estimated relative noise at the image's median depth, the relative noise that was added there, and the number of frames
whose depth has steps of whole disparities.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.datasets import open_dataset
from bidnerf_core.depth.noise import estimated_depth_noise
from bidnerf_core.depth.steps import depth_steps
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.faults import NO_FAULT, faulty, parse_faults
from bidnerf_core.evaluation.provenance import write_record
from bidnerf_core.frames.frame import View

RESULTS = Path(__file__).resolve().parent / "results"
FAULTS = (NO_FAULT, "depth-noise:0.005", "depth-noise:0.02", "depth-noise-squared:0.005")


def one_image(view: View, fault: str) -> dict[str, Any]:
    """Return the estimate of one image with a fault, at the median of its depth."""
    frame = faulty(view, fault, seed=0).frame
    if frame.depth is None or view.frame.depth is None:
        raise InputError(f"{view.frame.name}: no measured depth, expected images with depth")
    found, steps = estimated_depth_noise(frame.depth, frame.intrinsics), depth_steps(frame.depth)
    z = float(view.frame.depth[view.frame.depth > 0].median())
    return {
        "depth": z,
        "added": added(fault, z),
        "estimated": None if found is None else found.deviation(z) / z,
        "of_disparity": steps is not None and steps.of_disparity,
    }


def added(fault: str, depth: float) -> float:
    """Return the standard deviation of the noise that a fault adds at a depth (metres), relative to that depth."""
    if fault == NO_FAULT:
        return 0.0
    (part,) = parse_faults(fault)
    return part.size if part.name == "depth-noise" else part.size * depth


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the medians over the frames."""
    estimates = [row["estimated"] for row in rows if row["estimated"] is not None]
    return {
        "n": len(rows),
        "estimates": len(estimates),
        "median_depth": statistics.median(row["depth"] for row in rows),
        "added": statistics.median(row["added"] for row in rows),
        "estimated": statistics.median(estimates) if estimates else None,
        "steps_of_disparity": sum(row["of_disparity"] for row in rows),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("datasets", nargs="+", type=Path, metavar="DATA")
    parser.add_argument("--frames", type=int, default=10, help="frames of each dataset")
    given = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, Any] = {}
    for folder in given.datasets:
        dataset = open_dataset(folder)
        names = [name for i, name in enumerate(dataset.frame_names("test")) if i % 5 != 1]
        count = min(given.frames, len(names))
        views = dataset.views("test", [names[place * len(names) // count] for place in range(count)])
        for fault in FAULTS:
            found = summary([one_image(view, fault) for view in views])
            results.setdefault(folder.name, {})[fault] = found
            print(f"{folder.name:16} {fault:26} {found}", flush=True)
    print(write_record(RESULTS / "depth_noise.json", results, seed=0))


if __name__ == "__main__":
    main()
