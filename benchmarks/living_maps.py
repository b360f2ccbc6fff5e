"""Maps that change: in another unit, among many, and with more photos.

    python benchmarks/living_maps.py MAP:DATA [MAP:DATA ...] --part scale
    python benchmarks/living_maps.py MAP:DATA [MAP:DATA ...] --part which [--maps 50]
    python benchmarks/living_maps.py MAP:DATA --part extend --work DIR [--first 50] [--steps 500]

- ``scale``: a copy of each map, halved, stored, and scaled back: answers to test frames against those of the map;
- ``which``: the maps and textured grounds in closed form, as many as it takes to make ``--maps``: how often the one that an image shows
  is the most similar one, and is found, and the time against asking each for its landmarks;
- ``extend``: a map of the first photos of a dataset (evenly spaced), extended by the others, with and without the first ones at hand,
  against one of all, trained for ``--steps``. Maps are kept in DIR, and a run that was stopped goes on with those that are there.
"""

from __future__ import annotations

import json
import statistics
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from _lab import LIMITS, RESULTS, Scene, one_thread, parser, record, without_depth

import bidnerf as bn
from bidnerf.results import pose_error
from bidnerf.scenes import orbit
from bidnerf.testing import BOUNDS, POSES, ground, view
from bidnerf_core.captures import stored_cameras
from bidnerf_core.errors import InputError
from bidnerf_core.mapping import build_landmarks
from bidnerf_core.maps import MapInfo, rendering_scores

GROUND_VIEWS = 6


def scaled(scene: Scene, frames: int) -> dict[str, Any]:
    """Halve a map, store it, scale it back, and compare answers."""
    with TemporaryDirectory() as folder:
        scene.map.scaled(0.5, "units").save(Path(folder) / "half")
        half = bn.load_map(Path(folder) / "half")
        again = half.scaled(2.0, scene.map.unit)
    localizers = [bn.Localizer(each) for each in (scene.map, half, again)]
    rows = []
    for each in scene.views(count=frames):
        own, small, back = (localizer(without_depth(each).frame) for localizer in localizers)
        rows.append(
            {
                "same_outcomes": own.outcome == small.outcome == back.outcome,
                "same_bits": torch.equal(own.T_world_camera.matrix(), back.T_world_camera.matrix()),
                "off": float((2 * small.T_world_camera.translation - own.T_world_camera.translation).norm()),
            }
        )
    return {
        "n": len(rows),
        "same_outcomes": sum(row["same_outcomes"] for row in rows),
        "scaled_back_same_to_the_bit": sum(row["same_bits"] for row in rows),
        "halved_off_at_most": max(row["off"] for row in rows),
    }


def which(scenes: list[Scene], count: int, frames: int) -> dict[str, Any]:
    """Ask many maps which of them an image shows."""
    maps = [replace(scene.map, folder=None, info=replace(scene.map.info, data=scene.name)) for scene in scenes]
    queries = [(scene.name, without_depth(each).frame) for scene in scenes for each in scene.views(count=frames)]
    for seed in range(count - len(maps)):
        images = [view(T, f"{n}", seed) for n, T in enumerate(orbit(1.8, GROUND_VIEWS, elevation=(45.0, 75.0), seed=0))]
        info = MapInfo(
            "ground", {}, BOUNDS, 1, True, f"ground{seed}", weights=f"g{seed}", cameras=stored_cameras(images)
        )
        maps.append(bn.Map(info, ground(seed), None, build_landmarks(images)))
        queries.append((f"ground{seed}", without_depth(view(POSES[1], "unseen", seed)).frame))
    began = time.process_time()
    collection = bn.MapCollection(maps)
    index, rows = time.process_time() - began, []
    for name in collection.names:
        collection.localizer(name)  # so that times are those of queries
    for truth, frame in queries:
        began = time.process_time()
        ranking = list(collection.ranked(frame))
        ranked = time.process_time() - began
        began = time.process_time()
        try:
            placed = collection(frame)
        except InputError:
            rows.append(
                {
                    "first": ranking[0] == truth,
                    "right": False,
                    "wrong": False,
                    "rank": ranked,
                    "all": 0.0,
                    "asked": 0,
                }
            )
            continue
        rows.append(
            {
                "first": ranking[0] == truth,
                "right": placed.converged and placed.map == truth,
                "wrong": placed.converged and placed.map != truth,
                "rank": ranked,
                "all": time.process_time() - began,
                "asked": len(placed.asked),
                "rank_of_truth": ranking.index(truth) + 1,
            }
        )
    each_asked = bn.MapCollection(maps, asked=len(maps))
    each_asked._localizers = collection._localizers
    times, agreed = [], 0
    for truth, frame in queries[:: max(1, len(queries) // 12)]:
        began = time.process_time()
        found = {name: each_asked._by_landmarks(name, frame, 0).converged for name in each_asked.names}
        times.append(time.process_time() - began)
        agreed += [name for name, converged in found.items() if converged] == [truth]
    return {
        "maps": len(maps),
        "images": len(rows),
        "index_seconds": index,
        "most_similar_is_right": sum(row["first"] for row in rows),
        "found": sum(row["right"] for row in rows),
        "accepted_in_a_wrong_map": sum(row["wrong"] for row in rows),
        "worst_rank": max(row.get("rank_of_truth", len(maps)) for row in rows),
        "rank_seconds": statistics.median(row["rank"] for row in rows),
        "seconds": statistics.median(row["all"] for row in rows),
        "asked": statistics.fmean(row["asked"] for row in rows),
        "each_asked": {"images": len(times), "found_in_its_own_alone": agreed, "seconds": statistics.median(times)},
    }


def extended(scene: Scene, first: int, steps: int, work: Path) -> dict[str, Any]:
    """Train on some photos, add the others, and compare with all at once."""
    views = scene.dataset.views("train")
    chosen = {n * len(views) // first for n in range(first)}
    some = [each for n, each in enumerate(views) if n in chosen]
    rest = [each.frame for n, each in enumerate(views) if n not in chosen]
    options: dict[str, Any] = {
        "config": {"steps": steps},
        "refine_poses": "never",
        "background": scene.map.bounds.background,
    }
    results: dict[str, Any] = {}

    def kept(name: str, make: Any) -> None:
        folder, facts = work / name, work / f"{name}.json"
        if not facts.exists():
            began = time.process_time()
            make(folder)
            facts.write_text(json.dumps({"seconds": time.process_time() - began}))
        results[name] = json.loads(facts.read_text())
        if "psnr" not in results[name]:
            results[name] |= measured(bn.load_map(folder), scene)
            facts.write_text(json.dumps(results[name]))
        print(name, results[name], flush=True)

    def grown(folder: Path, old: Any) -> None:
        bn.load_map(work / "first").save(folder, overwrite=True)
        bn.extend(folder, rest, old)

    replacing = bn.TrainOptions(overwrite=True)
    kept("first", lambda folder: bn.train(some, out=folder, options=replacing, **options))
    kept("extended", lambda folder: grown(folder, None))
    kept("all", lambda folder: bn.train(views, out=folder, options=replacing, **options))
    kept("extended_with_data", lambda folder: grown(folder, some))
    return {"first": first, "added": len(rest), "steps": steps, "maps": results}


def measured(stored: bn.Map, scene: Scene) -> dict[str, Any]:
    """Return the quality of a map, by the test photos."""
    localizer, rows = bn.Localizer(stored), []
    views = scene.dataset.views("test")
    scores = [rendering_scores(stored.render(each), each.frame).psnr for each in views]
    for each in views:
        found = localizer(each.frame)
        error = pose_error(found.T_world_camera, each.T_ref_camera)
        rows.append((found.converged, float(error.translation), float(error.rotation_deg)))
    within = {name: sum(t < length and r < degrees for _, t, r in rows) for name, (length, degrees) in LIMITS.items()}
    return {
        "psnr": statistics.fmean(scores),
        "images": len(stored.info.cameras),
        "landmarks": len(stored.landmarks or ()),
        "test": len(rows),
        "accepted": sum(row[0] for row in rows),
        "right": within,
        "median_translation": statistics.median(row[1] for row in rows),
    }


def main() -> None:
    arguments = parser(__doc__, "living_maps", scenes=True)
    arguments.add_argument(
        "--part", nargs="+", choices=("scale", "which", "extend"), default=["scale", "which", "extend"]
    )
    arguments.add_argument("--maps", type=int, default=50)
    arguments.add_argument("--first", type=int, default=50)
    arguments.add_argument("--steps", type=int, default=500)
    arguments.add_argument("--work", type=Path, help="folder of the maps of part extend")
    given = arguments.parse_args()
    one_thread()
    before = RESULTS / f"{given.name}.json"
    results: dict[str, Any] = json.loads(before.read_text())["results"] if before.exists() else {}
    scenes = [Scene.open(pair) for pair in given.scenes]
    if "scale" in given.part:
        results["scale"] = results.get("scale", {}) | {each.name: scaled(each, given.frames or 10) for each in scenes}
    if "which" in given.part:
        results["which"] = which(scenes, given.maps, given.frames or 5)
    if "extend" in given.part:
        given.work.mkdir(parents=True, exist_ok=True)
        results["extend"] = results.get("extend", {}) | {
            each.name: extended(each, given.first, given.steps, given.work) for each in scenes
        }
    print(json.dumps(results, indent=1))
    record(given.name, results)


if __name__ == "__main__":
    main()
