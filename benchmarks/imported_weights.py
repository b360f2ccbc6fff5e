"""Weights that others trained, against real images: how well they are seen, and whether poses are found in them.

    pip install ./plugins/bidnerf-nerf-pytorch
    python benchmarks/imported_weights.py CHECKPOINT DATA --name imported_weights_lego

The checkpoint is imported twice with the plugin's own command: as its README has it, for the PSNR of both levels on test
images averaged over 2 x 2 pixels; and with ``--box`` and fewer samples a ray, for poses found by ``bid`` from starts of
protocol ``bid``, in every combination of coarse and fine level with RGB and RGB-D, from the same starts. An RGB image
has no depth at all, so that its pivot comes from the scene's box. One thread; what is finished is kept in a ``.jsonl``
beside the record, so that an interrupted run goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from kornia.metrics import psnr
from record import RESULTS, write_record
from scipy.stats import binomtest

from bidnerf_core.datasets import Dataset, open_dataset
from bidnerf_core.evaluation import protocols
from bidnerf_core.evaluation.errors import CRITERIA, PoseError, pose_error, steps_to_success, success_rate
from bidnerf_core.evaluation.figures import depth_to_rgb, tile
from bidnerf_core.field import levels
from bidnerf_core.frames import Frame, View
from bidnerf_core.localization import BidConfig, localize, single
from bidnerf_core.rendering import render_image
from bidnerf_core.serialization import to_plain
from bidnerf_core.storage import Map, load_map
from bidnerf_nerf_pytorch.command import main as import_command

LEVELS = {"coarse": 0, "fine": 1}
CELLS = [(level, sensor) for level in LEVELS for sensor in ("RGB-D", "RGB")]
DESCENT = BidConfig(rays=1024)  # half as many as usual: what one thread affords
SHRINK = 2  # of images, for their PSNR


def imported(given: argparse.Namespace, folder: Path) -> tuple[Map, Map]:
    """As the README has it; and within the object's box, with few samples."""
    box = ["--box", *(str(edge) for edge in given.box)]
    quick = [*box, "--coarse-samples", str(given.samples[0]), "--fine-samples", str(given.samples[1])]
    for name, options in (("plain", []), ("quick", quick)):
        if import_command([str(given.checkpoint), "--out", str(folder / name), *options]):
            raise SystemExit(1)
    return load_map(folder / "plain"), load_map(folder / "quick")


def shrunk(frame: Frame) -> Frame:
    """Colours averaged; depth is left out, since the mean of two surfaces lies on neither."""
    rgb = torch.nn.functional.avg_pool2d(frame.rgb.movedim(-1, 0), SHRINK).movedim(0, -1)
    return Frame(frame.name, rgb, frame.intrinsics.scaled(1 / SHRINK))


class Kept:
    """Results by key, in a file of one line each."""

    def __init__(self, path: Path) -> None:
        lines = path.read_text().splitlines() if path.exists() else []
        self.path = path
        self.rows = {
            line["key"]: line["row"] for line in map(json.loads, (x for x in lines if x.endswith("}")))
        }

    def get(self, key: list[Any], make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        text = json.dumps(key)
        if text not in self.rows:
            self.rows[text] = make()
            with self.path.open("a") as file:
                file.write(json.dumps({"key": text, "row": self.rows[text]}) + "\n")
        return self.rows[text]


def seen(stored: Map, view: View, picture: Path | None) -> dict[str, float]:
    """PSNR of each level; drawn where a file is named."""
    frame = shrunk(view.frame)
    images = [
        render_image(level, frame.intrinsics, view.T_ref_camera, stored.bounds)
        for level in levels(stored.field)
    ]
    if picture is not None:
        row = {"real": frame.rgb, **dict(zip(LEVELS, (image.rgb for image in images), strict=True))}
        row["depth, fine"] = depth_to_rgb(images[-1].depth)
        iio.imwrite(picture, np.concatenate([tile(image, name) for name, image in row.items()], axis=1))
    found = {n: float(psnr(i.rgb, frame.rgb, 1.0)) for n, i in zip(LEVELS, images, strict=True)}
    print(
        f"{frame.name}: " + ", ".join(f"{name} {value:.2f} dB" for name, value in found.items()), flush=True
    )
    return found


def image_quality(stored: Map, dataset: Dataset, given: argparse.Namespace, kept: Kept) -> dict[str, Any]:
    """Of frames spread evenly over the test split; the first is drawn."""
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


def trial(stored: Map, view: View, level: str, sensor: str, seed: int, size: float) -> dict[str, Any]:
    """One line of results."""
    start = protocols.bid(view.T_ref_camera, size, seed)
    blind = sensor == "RGB"
    frame = replace(view.frame, depth=None) if blind else view.frame
    config = replace(DESCENT, level=LEVELS[level], depth_weight=0.0 if blind else 1.0)
    found = localize(single(stored.field, stored.bounds, frame, start), "bid", config, seed)
    errors = pose_error(found.poses, view.T_ref_camera)
    return {
        "level": level, "sensor": sensor, "frame": frame.name, "seed": seed, "converged": found.converged,
        "steps": found.steps, "seconds": found.seconds, "loss": found.loss,
        "translation": errors.translation.tolist(), "rotation_deg": errors.rotation_deg.tolist(),
    }  # fmt: skip


def all_trials(stored: Map, dataset: Dataset, given: argparse.Namespace, kept: Kept) -> list[dict[str, Any]]:
    """Start by start, so that an interrupted run has the same starts in every cell; fine ones, which cost five times as
    much, from the first few only.
    """
    names = [n for i, n in enumerate(dataset.frame_names("test")) if i % 5 != 1]  # those were tuned on
    rows = []
    for number in range(given.trials):
        seed, name = given.seed + number, names[number % len(names)]
        (view,) = dataset.views("test", [name])
        for level, sensor in CELLS if number < given.fine_trials else CELLS[:2]:
            key = [given.checkpoint.name, name, seed, level, sensor, to_plain(DESCENT), given.box]
            rows.append(
                kept.get(
                    [*key, given.samples, given.size],
                    lambda v=view, lv=level, sn=sensor, sd=seed: trial(stored, v, lv, sn, sd, given.size),
                )
            )
            print(f"{number + 1}/{given.trials} {told(rows[-1])}", flush=True)
    return rows


def told(row: dict[str, Any]) -> str:
    errors = f"{row['translation'][-1]:.3f} units, {row['rotation_deg'][-1]:.2f} deg"
    return f"{row['frame']} {row['level']} {row['sensor']}: {errors}, {row['seconds']:.0f} s"


def successes(rows: list[dict[str, Any]], name: str) -> list[bool]:
    return [bool(CRITERIA[name](trace(row)[-1], trace(row)[0])) for row in rows]


def trace(row: dict[str, Any]) -> PoseError:
    return PoseError(torch.tensor(row["translation"]), torch.tensor(row["rotation_deg"]))


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of one cell: rates with Wilson intervals, errors, steps and time."""
    result: dict[str, Any] = {"trials": len(rows)}
    for name, criterion in CRITERIA.items():
        result[name] = asdict(success_rate(sum(successes(rows, name)), len(rows)))
        reached = [s for row in rows if (s := steps_to_success(trace(row), criterion)) is not None]
        result[name]["median_steps_to_success"] = statistics.median(reached) if reached else None
    result["median_translation"] = statistics.median(row["translation"][-1] for row in rows)
    result["median_rotation_deg"] = statistics.median(row["rotation_deg"][-1] for row in rows)
    result["seconds_per_step"] = statistics.median(row["seconds"] / row["steps"] for row in rows)
    return result


def difference(first: list[dict[str, Any]], second: list[dict[str, Any]]) -> dict[str, Any]:
    """Starts from which only one of two cells succeeded; exact McNemar test, two-sided."""
    result: dict[str, Any] = {}
    for name in CRITERIA:
        pairs = list(zip(successes(first, name), successes(second, name), strict=False))  # starts of both
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
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--name", required=True, help="of the record")
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
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        plain, quick = imported(given, Path(folder))
    dataset = open_dataset(given.data, plain.bounds.background)
    kept = Kept(RESULTS / f"{given.name}.partial.jsonl")
    rows = all_trials(quick, dataset, given, kept)
    quality = image_quality(plain, dataset, given, kept)
    cells = {cell: [r for r in rows if (r["level"], r["sensor"]) == cell] for cell in CELLS}
    differences = {
        f"{' '.join(a)} against {' '.join(b)}": difference(cells[a], cells[b])
        for i, a in enumerate(CELLS)
        for b in CELLS[i + 1 :]
    }
    results = {
        "checkpoint": f"{given.checkpoint.parent.name}/{given.checkpoint.name}", "data": given.data.name,
        "image_quality": {"size": f"1/{SHRINK} of the images", "map": to_plain(plain.info), **quality},
        "start": f"bid:{given.size}", "localization_map": to_plain(quick.info), "settings": to_plain(DESCENT),
        "cells": {" ".join(cell): summary(found) for cell, found in cells.items()},
        "differences": differences,
        "rows": [{k: (v[-1] if isinstance(v, list) else v) for k, v in row.items()} for row in rows],
    }  # fmt: skip
    print(write_record(given.name, results, given.seed))
    print(json.dumps({"quality": quality, **results["cells"]}, indent=1))
    kept.path.unlink()


if __name__ == "__main__":
    main()
