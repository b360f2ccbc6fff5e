"""What masks are worth: a capture through half of whose images a person walks, trained with and without masks.

    python benchmarks/masks.py DATA [DATA ...] [--steps 600] [--share 0.15] [--name masks]

A figure with a textured body and head is pasted into every second training image, where it covers ``share`` of the image and
walks to and fro as the images follow one another; in images with depth it stands at a third of the median depth. Three maps are
trained: of the images as they were, of those with the person, and of those with the person under masks that are three pixels
too large on all sides. Recorded are the PSNR of the test images, none of which shows the person; the landmarks, and those of
them most of whose keypoints lie on the person; and the localization of the test images as they are, with the person, and with the
person under a mask. Each map is a row of ``NAME.rows.jsonl``, from which an interrupted run goes on.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import _lab
import torch
from torch import Tensor

from bidnerf import InputError, Localizer, Map, TrainOptions, View, load_map, open_dataset, resume, train
from bidnerf_core.backend import render_image
from bidnerf_core.datasets import DatasetOptions
from bidnerf_core.mapping import DEFAULT_LANDMARKS, tracked_views
from bidnerf_core.maps import rendering_scores

GROWN = 3
"""Pixels by which a mask is larger than the person."""
PERIOD = 24
"""Images in which the person walks to and fro once."""
NEAR = 1 / 3
"""Distance of the person, as a share of the median depth."""
WAYS = ("without person", "with person", "with person and masks")


def figure(height: int, width: int, share: float, phase: float) -> tuple[Tensor, Tensor]:
    """Return where a person is in an image (h w, bool) and its colours, of the same clothes in every image.

    The person stands at a place that ``phase`` (radians) moves along the image, and covers about ``share`` of it.
    """
    tall = min(0.95 * height, math.sqrt(3.2 * share * height * width))
    wide = share * height * width / (0.75 * tall)
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    middle = width * (0.5 + 0.3 * math.sin(phase))
    x, y = (u - middle) / wide, (v - (height - tall)) / tall  # the person stands on the lower border
    body = (x.abs() < 0.5 - 0.15 * (y - 0.5).abs()) & (y > 0.2)
    head = (x / 0.3) ** 2 + ((y - 0.11) / 0.11) ** 2 < 1
    generator = torch.Generator().manual_seed(7)
    colours = torch.zeros(3, 64, 64)
    for cells in (4, 16, 64):
        octave = torch.rand(1, 3, cells, cells, generator=generator)
        colours += torch.nn.functional.interpolate(octave, (64, 64), mode="bicubic")[0] / 3
    row, column = (64 * y).long().clamp(0, 63), (64 * (x + 0.5)).long().clamp(0, 63)
    return body | head, (1.6 * colours - 0.3).clamp(0, 1)[:, row, column].movedim(0, -1)


def with_person(view: View, share: float, phase: float) -> tuple[View, Tensor]:
    """Return the view with a person in it, and where it is."""
    frame = view.frame
    there, colours = figure(*frame.rgb.shape[:2], share, phase)
    rgb, depth = torch.where(there[..., None], colours, frame.rgb), frame.depth
    if depth is not None and frame.has_depth:
        depth = torch.where(there, NEAR * depth[depth > 0].median(), depth)
    alpha = None if frame.alpha is None else torch.where(there, 1.0, frame.alpha)
    return replace(view, frame=replace(frame, rgb=rgb, depth=depth, alpha=alpha)), there


def under_mask(view: View, there: Tensor) -> View:
    """Return the view with the person hidden by a mask that is a little too large."""
    size = 2 * GROWN + 1
    hidden = torch.nn.functional.max_pool2d(there.float()[None], size, 1, GROWN)[0] > 0
    return replace(view, frame=view.frame.replace(hidden=hidden))


def capture(views: Sequence[View], way: str, share: float) -> tuple[list[View], list[Tensor]]:
    """Return the training images of one way, and where the person is in each."""
    taken, places = [], []
    for number, view in enumerate(views):
        seen, there = with_person(view, share, 2 * math.pi * number / PERIOD)
        if way == WAYS[0] or number % 2:
            seen, there = view, torch.zeros_like(there)
        taken.append(under_mask(seen, there) if way == WAYS[2] and bool(there.any()) else seen)
        places.append(there)
    return taken, places


def landmarks(views: Sequence[View], places: Sequence[Tensor]) -> dict[str, int]:
    """Count the triangulated landmarks, and those most of whose keypoints lie on the person."""
    kept, positions = tracked_views(views).triangulated(DEFAULT_LANDMARKS)
    pixels = torch.cat([image.keypoints.pixels for image in kept.images])[kept.number]
    columns, rows = pixels.long().unbind(-1)
    height, width = places[0].shape
    on = torch.stack(list(places))[kept.image, rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
    count, wrong = (torch.bincount(kept.point, w, len(positions)) for w in (None, on.double()))
    return {"landmarks": len(positions), "on_person": int((2 * wrong > count).sum())}


def tested(scene: Map, views: Sequence[View], share: float) -> dict[str, Any]:
    """Return the PSNR of the test images, and how they are localized as they are, with the person, and under a mask."""
    scores = [
        rendering_scores(render_image(scene.field, v.frame.intrinsics, v.T_ref_camera, scene.bounds), v.frame)
        for v in views
    ]
    found: dict[str, Any] = {"psnr": sum(score.psnr for score in scores) / len(scores)}
    localizer = Localizer(scene)
    shown = [with_person(v, 2 * share, 2 * math.pi * number / 5) for number, v in enumerate(views)]
    queries = {
        "as they are": list(views),
        "with person": [view for view, _ in shown],
        "with person and mask": [under_mask(view, there) for view, there in shown],
    }
    for name, some in queries.items():
        rows = [_lab.answer(lambda v=v: localizer(v.frame), v) for v in map(_lab.without_depth, some)]  # type: ignore[misc]
        print(_lab.line(name, rows), flush=True)
        found[name] = _lab.rates(rows) | _lab.judgement(rows)
    return found


def trained(out: Path, views: Sequence[View], steps: int, background: tuple[float, float, float]) -> Map:
    """Train a map in the folder ``out``, or go on where that was interrupted."""
    if (out / "map.json").exists():
        try:
            return resume(
                out,
                views,
                options=TrainOptions(images=DatasetOptions(background=background), checkpoint_seconds=30),
            )
        except InputError:  # nothing is left to do
            return load_map(out)
    return train(
        views,
        out=out,
        config={"steps": steps},
        options=TrainOptions(images=DatasetOptions(background=background), checkpoint_seconds=30),
    )


def measured(data: Path, way: str, steps: int, share: float, work: Path) -> dict[str, Any]:
    dataset = open_dataset(data)
    views, places = capture(dataset.views("train"), way, share)
    counts = landmarks(views, places)
    print(data.name, way, counts, flush=True)
    began = time.monotonic()
    scene = trained(work / f"{data.name} {way} {steps}", views, steps, dataset.background)
    seconds = time.monotonic() - began
    test = dataset.views("test", _lab.held_out(dataset.frame_names("test")))
    return {**counts, "train_seconds": seconds, **tested(scene, test, share)}


def main() -> None:
    arguments = _lab.parser(__doc__, "masks")
    arguments.add_argument("data", nargs="+", type=Path, metavar="DATA")
    arguments.add_argument("--steps", type=int, default=600)
    arguments.add_argument("--share", type=float, default=0.15)
    arguments.add_argument("--work", type=Path, default=Path("masks-work"), help="folder of the maps")
    given = arguments.parse_args()
    _lab.one_thread()
    file = _lab.RESULTS / f"{given.name}.rows.jsonl"
    known = [json.loads(row) for row in file.read_text().splitlines()] if file.exists() else []
    rows = {json.dumps(row["key"]): row["found"] for row in known}
    results: dict[str, Any] = {"steps": given.steps, "share": given.share}
    for data in given.data:
        for way in WAYS:
            key = [data.name, way, given.steps, given.share]
            if json.dumps(key) not in rows:
                rows[json.dumps(key)] = measured(data, way, given.steps, given.share, given.work)
                with file.open("a") as stream:
                    stream.write(json.dumps({"key": key, "found": rows[json.dumps(key)]}) + "\n")
            results.setdefault(data.name, {})[way] = rows[json.dumps(key)]
    _lab.record(given.name, results)


if __name__ == "__main__":
    main()
