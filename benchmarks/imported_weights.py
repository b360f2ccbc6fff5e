"""Weights trained by others: the quality of their renderings of real images, and the success of localization in them.

    pip install ./plugins/bidnerf-nerf-pytorch
    python benchmarks/imported_weights.py CHECKPOINT DATA --name imported_weights_lego

The checkpoint is imported twice with the plugin's own command: as in its README, for the PSNR of both levels on test
images averaged over 2 x 2 pixels; and with ``--box`` and fewer samples per ray, for poses found by ``bid`` from starts of
protocol ``bid``, in every combination of coarse and fine level with RGB and RGB-D, from the same starts. An RGB image
has no depth at all, so that its pivot comes from the scene's box. One thread runs everything; finished rows are kept in
``.jsonl`` files next to the record, so that an interrupted run resumes where it stopped.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import statistics
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import _lab
import cv2
import imageio.v3 as iio
import numpy as np
import torch
from _lab import RowStore
from kornia.metrics import psnr
from scipy.stats import binomtest

from bidnerf_core.datasets import Capture, open_dataset
from bidnerf_core.evaluation import (
    NEVER,
    ResultsFile,
    Trial,
    TrialResult,
    run_trial,
    steps_of,
    summarize,
)
from bidnerf_core.fields import levels, render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.io import to_plain
from bidnerf_core.maps import Map, import_map
from bidnerf_core.results import CRITERIA, tile

LEVELS = {"coarse": 0, "fine": 1}
Cell = tuple[str, str]
CELLS = [(level, sensor) for level in LEVELS for sensor in ("RGB-D", "RGB")]
DESCENT = {"rays": 1024}  # half of the default, which suits one thread
SHRINK = 2  # of images, for their PSNR


def coloured(depth: torch.Tensor) -> np.ndarray:
    """Return depth (metres) in colours from red, the first percentile, to blue, the 99th; dark where there is none."""
    array = depth.double().cpu().numpy()
    known = np.isfinite(array) & (array > 0)
    low, high = np.percentile(array[known], (1, 99)) if known.any() else (0.0, 1.0)
    share = ((np.where(known, array, low) - low) / max(high - low, 1e-9)).clip(0, 1)
    # The ends of the colour map are nearly black.
    levels = (255 * (0.96 - 0.9 * share)).round().astype(np.uint8)
    turbo = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)[..., ::-1]  # to RGB
    return np.where(known[..., None], turbo, np.array((38, 38, 42), np.uint8))


def quick_name(given: argparse.Namespace) -> str:
    """Return a folder's name that depends on checkpoint, box and samples, since it identifies trials."""
    asked = json.dumps([given.checkpoint.name, given.box, given.samples])
    return f"quick-{hashlib.sha256(asked.encode()).hexdigest()[:8]}"


def imported(given: argparse.Namespace, folder: Path) -> tuple[Map, Map]:
    """Return the map as imported in the README, and one limited to the object's box with few samples per ray."""
    quick = {"box": tuple(given.box), "coarse_samples": given.samples[0], "fine_samples": given.samples[1]}
    plain, limited = (
        import_map(given.checkpoint, folder / name, config, bake=False)
        for name, config in (("plain", {}), (quick_name(given), quick))
    )
    return plain, limited


def shrunk(frame: Frame) -> Frame:
    """Return the frame with averaged colours, without depth, since the mean of two surfaces lies on neither."""
    rgb = torch.nn.functional.avg_pool2d(frame.rgb.movedim(-1, 0), SHRINK).movedim(0, -1)
    return Frame(frame.name, rgb, frame.intrinsics.scaled(1 / SHRINK))


def seen(stored: Map, view: View, picture: Path | None) -> dict[str, float]:
    """Return the PSNR of each level, and draw the images if ``picture`` is given."""
    frame = shrunk(view.frame)
    images = [
        render_image(level, frame.intrinsics, view.T_ref_camera, stored.bounds)
        for level in levels(stored.field)
    ]
    if picture is not None:
        row = {"real": frame.rgb, **dict(zip(LEVELS, (image.rgb for image in images), strict=True))}
        row["depth, fine"] = coloured(images[-1].depth)
        iio.imwrite(picture, np.concatenate([tile(image, name) for name, image in row.items()], axis=1))
    found = {n: float(psnr(i.rgb, frame.rgb, 1.0)) for n, i in zip(LEVELS, images, strict=True)}
    print(
        f"{frame.name}: " + ", ".join(f"{name} {value:.2f} dB" for name, value in found.items()), flush=True
    )
    return found


def image_quality(stored: Map, dataset: Capture, given: argparse.Namespace, kept: RowStore) -> dict[str, Any]:
    """Return the PSNR of frames spread evenly over the test split; the first one is drawn."""
    names = dataset.frame_names("test")
    rows = []
    for number, name in enumerate(names[:: max(1, len(names) // given.frames)][: given.frames]):
        (view,) = dataset.views("test", [name])
        picture = given.picture if number == 0 else None
        rows.append(kept.get([given.checkpoint.name, name], lambda v=view, p=picture: seen(stored, v, p)))
    quality = {level: [row[level] for row in rows] for level in LEVELS}
    return {
        level: {"frames": len(q), "psnr_mean_dB": statistics.fmean(q), "psnr_lowest_dB": min(q)}
        for level, q in quality.items()
    }


def cell_trial(folder: Path, given: argparse.Namespace, cell: Cell, frame: str, seed: int) -> Trial:
    """Return the trial of one level and sensor. Without depth, the pivot is the middle of the box."""
    level, sensor = cell
    blind = sensor == "RGB"
    settings = DESCENT | {"level": LEVELS[level], "depth_weight": 0.0 if blind else 1.0}
    return Trial(
        str(folder), str(given.data), (frame,), (given.size,), seed, protocol="bid", method="bid",
        config=json.dumps(settings, sort_keys=True), depth=not blind,
    )  # fmt: skip


def all_trials(folder: Path, dataset: Capture, given: argparse.Namespace) -> dict[Cell, list[TrialResult]]:
    """Return the results of each cell.

    Trials run start by start, so that an interrupted run has the same starts in every cell. Fine levels, which cost five
    times as much, are tried from the first few starts only.
    """
    names = _lab.held_out(dataset.frame_names("test"))
    cells: dict[Cell, list[TrialResult]] = {cell: [] for cell in CELLS}
    with ResultsFile(_lab.RESULTS / f"{given.name}.partial.jsonl") as file:
        for number in range(given.trials):
            for cell in CELLS if number < given.fine_trials else CELLS[:2]:
                trial = cell_trial(folder, given, cell, names[number % len(names)], given.seed + number)
                if trial not in file:
                    file.add(run_trial(trial))
                cells[cell].append(file[trial])
                print(f"{number + 1}/{given.trials} {row_text(cell, cells[cell][-1])}", flush=True)
    return cells


def row_text(cell: Cell, row: TrialResult) -> str:
    """Return a trial as a line for the terminal."""
    error = row.error
    errors = f"{error.translation:.3f} units, {error.rotation_deg:.2f} deg" if error else "not finite"
    return f"{row.frame} {' '.join(cell)}: {errors}, {row.seconds:.0f} s"


def difference(first: list[TrialResult], second: list[TrialResult]) -> dict[str, Any]:
    """Return the numbers of starts from which only one of two cells succeeded, and McNemar's exact two-sided p value."""
    result: dict[str, Any] = {}
    for name in CRITERIA:
        good = [[steps < NEVER for steps in steps_of(rows, name)] for rows in (first, second)]
        pairs = list(zip(*good, strict=False))  # starts from which both were tried
        only = (sum(a and not b for a, b in pairs), sum(b and not a for a, b in pairs))
        p = binomtest(only[0], sum(only)).pvalue if sum(only) else 1.0
        result[name] = {
            "starts": len(pairs),
            "only_first": only[0],
            "only_second": only[1],
            "mcnemar_p": float(p),
        }
    return result


def main() -> None:
    parser = _lab.parser(__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--frames", type=int, default=10, help="for PSNR, evenly among the test split")
    parser.add_argument("--trials", type=int, default=20, help="starts, tried with RGB-D and RGB")
    parser.add_argument("--fine-trials", type=int, default=20, help="of these, tried in full detail as well")
    parser.add_argument("--size", type=float, default=0.5, help="of protocol bid")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--box", type=float, nargs=6, default=[-0.75, -1.25, -0.7, 0.75, 1.25, 1.15])
    parser.add_argument(
        "--samples", type=int, nargs=2, default=[24, 16], help="coarse, fine, for localization"
    )
    parser.add_argument("--picture", type=Path, help="file for a real image beside what the map shows")
    given = parser.parse_args()
    _lab.one_thread()
    quality_rows = _lab.RESULTS / f"{given.name}.partial.rows.jsonl"
    with tempfile.TemporaryDirectory() as folder, RowStore(quality_rows) as kept:
        plain, quick = imported(given, Path(folder))
        dataset = open_dataset(given.data, plain.bounds.background)
        cells = all_trials(Path(folder) / quick_name(given), dataset, given)
        quality = image_quality(plain, dataset, given, kept)
    differences = {
        f"{' '.join(a)} against {' '.join(b)}": difference(cells[a], cells[b])
        for i, a in enumerate(CELLS)
        for b in CELLS[i + 1 :]
    }
    results = {
        "checkpoint": f"{given.checkpoint.parent.name}/{given.checkpoint.name}", "data": given.data.name,
        "image_quality": {"size": f"1/{SHRINK} of the images", "map": to_plain(plain.info), **quality},
        "start": f"bid:{given.size}", "localization_map": to_plain(quick.info), "settings": DESCENT,
        "cells": {" ".join(cell): asdict(summarize(found)) for cell, found in cells.items() if found},
        "differences": differences,
    }  # fmt: skip
    _lab.record(given.name, results, given.seed)
    print(json.dumps({"quality": quality, **results["cells"]}, indent=1))
    for partial in (quality_rows, _lab.RESULTS / f"{given.name}.partial.jsonl"):
        partial.unlink()


if __name__ == "__main__":
    main()
