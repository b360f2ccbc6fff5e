"""Gaussian splats that were trained here, beside hash grids of the same images.

    python benchmarks/splats.py SPLAT:HASHGRID:DATA [SPLAT:HASHGRID:DATA ...] [--images 8] [--pairs 10] [--methods bid bid-lm]

SPLAT and HASHGRID are maps of DATA (``bidnerf train --backend gaussians``, ``--backend hashgrid``). Recorded are the quality of rendered test
images (``--images``, evenly spaced), the size of the weights, the time of a training step of 2048 rays (rendering, loss, derivatives, Adam),
for which both fields take turns in one process, and the answers of method ``auto`` to test frames without a start, from RGB and from
RGB-D, in turn as well. ``--methods`` adds those that need a start, on a few frames (``--started``) of some scenes (``--start-in``)
from seeded starts that are ``START`` away. Answers are kept in a ``.rows.jsonl`` next to the record, so that an interrupted run resumes where it
stopped.
"""

from __future__ import annotations

import argparse
import copy
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from _lab import (
    RESULTS,
    Row,
    RowStore,
    Scene,
    answer,
    cpu_seconds,
    held_out,
    in_turn,
    judgement,
    line,
    modes,
    one_thread,
    parser,
    rates,
    record,
)
from map_quality import judge

from bidnerf import Localizer
from bidnerf_core.backend import load_backend
from bidnerf_core.fields import render
from bidnerf_core.frames import View
from bidnerf_core.geometry import perturb
from bidnerf_core.io import from_plain
from bidnerf_core.localization import settings_of
from bidnerf_core.training import Supervision

RAYS = 2048
"""Rays of the training step that is timed."""
START = (0.2, 10.0)
"""Distance (metres) and angle (degrees) of the starts from the truth."""
STEPS = {"bid": {"max_steps": 200, "rays": 512}}
"""Settings of the methods that need a start, where they differ from the defaults."""
WARM_UP = 2
"""Pairs of steps that are not counted."""


def trainer(scene: Scene) -> Callable[[], float]:
    """Return a function that trains a copy of a map's field by one step and returns the CPU time of that."""
    info = scene.map.info
    config = from_plain(load_backend(info.backend).config_type, info.config, "config")
    field = copy.deepcopy(scene.map.field).train()
    for parameter in field.parameters():
        parameter.requires_grad_(True)
    supervision = Supervision(scene.dataset.views("train"), scene.map.bounds, config, torch.device("cpu"))
    optimizer = torch.optim.Adam(field.parameters(), lr=1e-5, fused=True)
    generator = torch.Generator().manual_seed(0)

    def step() -> float:
        batch = supervision.draw(RAYS, generator)
        began = time.process_time()
        rendering = render(field, batch.rays, batch.background, generator)
        loss, _ = supervision.loss(rendering, batch)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return time.process_time() - began

    return step


def step_times(scenes: dict[str, Scene], pairs: int) -> dict[str, Any]:
    """Return the median time (ms) of a step of each field, and how many times longer the splat's takes."""
    steps = {name: trainer(scene) for name, scene in scenes.items()}
    times: dict[str, list[float]] = {name: [] for name in scenes}
    for turn in range(pairs + WARM_UP):
        for name in in_turn(list(scenes), turn):
            times[name].append(1000 * steps[name]())
    kept = {name: some[WARM_UP:] for name, some in times.items()}
    ratios = [a / b for a, b in zip(kept["gaussians"], kept["hashgrid"], strict=True)]
    medians = {name: statistics.median(some) for name, some in kept.items()}
    return {"pairs": pairs, "median_ms": medians, "times_longer": statistics.median(ratios)}


def quality(scene: Scene, images: int) -> dict[str, Any]:
    """Return the quality of renderings of test images, and the size of the map."""
    views = scene.dataset.views("test", held_out(scene.dataset.frame_names("test"), count=images))
    weights = sum(file.stat().st_size for file in scene.folder.glob("weights-*"))
    found = judge(scene.map.field, scene.map.bounds, views)
    names = ("frames", "psnr_mean_dB", "psnr_lowest_dB", "samples_per_ray", "depth_error_median")
    return {
        "steps": scene.map.info.step,
        "parameters": sum(p.numel() for p in scene.map.field.parameters()),
        "weights_MB": weights / 1e6,
        **{name: found[name] for name in names},
    }


def answers(scenes: dict[str, Scene], given: argparse.Namespace, store: RowStore) -> dict[str, Any]:
    """Return summaries of the answers in each map, by the kind of input."""
    localizers = {name: Localizer(scene.map) for name, scene in scenes.items()}
    views = next(iter(scenes.values())).views(given.tuning_frames, given.frames)

    def found(name: str, mode: str, view: View) -> Row:
        key = [*scenes[name].key, mode, view.frame.name]
        return store.get(key, lambda: answer(lambda: localizers[name](view.frame), view))

    return by_mode(scenes, views, "auto", found)


def by_mode(
    scenes: dict[str, Scene], views: list[View], method: str, found: Callable[[str, str, View], Row]
) -> dict[str, Any]:
    """Return summaries of what is found in each map in turn, by the kind of input."""
    summaries: dict[str, Any] = {}
    for mode, some in modes(views).items():
        rows: dict[str, list[Row]] = {name: [] for name in scenes}
        for place, view in enumerate(some):
            for name in in_turn(list(scenes), place):
                rows[name].append(found(name, mode, view))
        for name, scene in scenes.items():
            print(line(f"{scene.name} {mode} {method} {name}", rows[name]), flush=True)
        summaries[mode] = {
            name: {"n": len(part), **rates(part), **judgement(part), **cpu_seconds(part)} for name, part in rows.items()
        }
    return summaries


def started(scenes: dict[str, Scene], method: str, given: argparse.Namespace, store: RowStore) -> dict[str, Any]:
    """Return summaries of the answers of a method that needs a start."""
    settings = STEPS.get(method, {})
    config = settings_of(method, settings)
    localizers = {name: Localizer(scene.map, method, config) for name, scene in scenes.items()}
    views = next(iter(scenes.values())).views(given.tuning_frames, given.started)

    seeds = {view.frame.name: seed for seed, view in enumerate(views)}

    def found(name: str, mode: str, view: View) -> Row:
        seed = seeds[view.frame.name]
        start = perturb(view.T_ref_camera, *START, seed=seed)
        key = [*scenes[name].key, method, settings, START, seed, mode, view.frame.name]
        return store.get(key, lambda: answer(lambda: localizers[name](view.frame, start), view))

    return {"start": START, "settings": settings, **by_mode(scenes, views, method, found)}


def compared(triple: str, given: argparse.Namespace, store: RowStore) -> dict[str, Any]:
    """Return all measurements of a splat and a hash grid of the same images."""
    splat, grid, data = triple.split(":", 2)
    scenes = {"gaussians": Scene.open(f"{splat}:{data}"), "hashgrid": Scene.open(f"{grid}:{data}")}
    localized = answers(scenes, given, store)
    wanted = given.methods if Path(data).name in (given.start_in or [Path(data).name]) else []
    descents = {method: started(scenes, method, given, store) for method in wanted}
    measured = {}
    for name, scene in scenes.items():
        measured[name] = store.get(
            [*scene.key, "quality", given.images], lambda scene=scene: quality(scene, given.images)
        )
    keys = [key for scene in scenes.values() for key in scene.key]
    times = store.get([*keys, "steps", given.pairs], lambda: step_times(scenes, given.pairs))
    print(measured, times, flush=True)
    kept = {"maps": measured, "step_of_2048_rays": times, "answers": localized, "from_starts": descents}
    return {"data": Path(data).name, **kept}


def main() -> None:
    arguments = parser(__doc__, "splats")
    arguments.add_argument("scenes", nargs="+", metavar="SPLAT:HASHGRID:DATA")
    arguments.add_argument("--frames", type=int, help="test frames of each scene (default: all)")
    arguments.add_argument("--tuning-frames", action="store_true", help="only frames that settings are tuned on")
    arguments.add_argument("--images", type=int, default=8, help="test images to render (default: %(default)s)")
    arguments.add_argument("--pairs", type=int, default=10, help="timed steps of each field (default: %(default)s)")
    arguments.add_argument("--methods", nargs="*", default=[], help="methods that need a start")
    arguments.add_argument(
        "--start-in",
        nargs="+",
        metavar="DATA",
        help="names of the data that they are tried on (default: all)",
    )
    arguments.add_argument("--started", type=int, default=4, help="test frames with a start (default: %(default)s)")
    given = arguments.parse_args()
    one_thread()
    with RowStore(RESULTS / f"{given.name}.rows.jsonl") as store:
        found = [compared(triple, given, store) for triple in given.scenes]
    record(given.name, {"scenes": {result.pop("data"): result for result in found}})


if __name__ == "__main__":
    main()
