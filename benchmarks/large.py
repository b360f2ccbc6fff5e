"""What large maps take to build and to ask, whether rooms that look alike are told from one another, and one map from eighty.

    python benchmarks/large.py SCENE --others SCENE [SCENE ...]

1. The landmarks of a scene's map are joined with distractors: the descriptors of all keypoints in the images of other scenes, as they
   are, mirrored and turned by 180 degrees (a permutation of the channels of SIFT), at random places, each seen in three images.
   Localizers are opened, and asked for test frames without depth. A map in which the scene is ten times must refuse them.
2. Landmarks of 100 to 10,000 photos of a building of look-alike rooms, see ``_building.py``: CPU time and memory of each step after the
   detection of keypoints, with their growth, and answers to photos that are not in the map.
3. A building cut into eighty maps: what a photo takes in all of them together, beside the map that it is in.

Each measurement has a process of its own. SCENE is a name as ``answer_maps.py`` takes it. ``benchmarks/cache`` keeps keypoints.
"""

from __future__ import annotations

import contextlib
import json
import math
import multiprocessing
import statistics
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import torch
from _building import (
    PHOTOS,
    Photos,
    StoredKeypoints,
    bounds_of,
    folder_of_keypoints,
    keypoints_of,
    numbered,
    photo,
    poses_in,
)
from _lab import RESULTS, Row, RowStore, Scene, answer, capture_of, one_thread, parser, record, within, without_depth

from bidnerf import Localizer, Map, MapCollection, load_map
from bidnerf.results import success_rate
from bidnerf_core.captures import held_out_images, stored_cameras, tried_landmarks
from bidnerf_core.fields import NoField, SceneBounds
from bidnerf_core.frames import View
from bidnerf_core.mapping import (
    DEFAULT_LANDMARKS,
    SIFT,
    USUAL_FEATURES,
    DescriptorCells,
    InvertedFile,
    LandmarkMap,
    Tracks,
    concatenate,
    detect_keypoints,
    likely_pairs,
    squared_distances,
    track_views,
)
from bidnerf_core.maps import MapInfo

CACHE = Path(__file__).parent / "cache"
SIZES = (10_000, 100_000, 1_000_000)
"""Numbers of landmarks."""
COPIES = 10
IN_IMAGE = 700
"""Number of distractors that appear in an image for the first time."""
BUILDINGS = (100, 400, 1_600, 6_400, 10_000)
"""Numbers of photos."""
MAPS, CUT = 80, 6_400
"""Number of maps into which a building is cut, and its number of photos; a smaller one, if that is the largest."""
STEPS = ("pairs", "matches and tracks", "landmarks", "trial")
Result = TypeVar("Result")


def alone(work: Callable[..., Result], *arguments: Any) -> Result:
    """Return what a function returns in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(work, *arguments).result()


def memory() -> tuple[float, float]:
    """Return the memory that this process takes, and the most that it has taken, MB (of Linux)."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(status["VmRSS"].split()[0]) / 1e3, float(status["VmHWM"].split()[0]) / 1e3


def counts(rows: Sequence[Row]) -> Row:
    """Return how many answers are right, accepted, wrong of these, and their CPU time."""
    accepted = [row for row in rows if row["converged"]]
    return {
        "n": len(rows),
        "right": sum(map(within, rows)),
        "accepted": len(accepted),
        "silent": sum(not within(row) for row in accepted),
        "ambiguous": sum(row["outcome"] == "ambiguous" for row in rows),
        "median_cpu_seconds": statistics.median(row["cpu_seconds"] for row in rows),
    }


# A scene among distractors.


def distractors(scenes: Sequence[str]) -> torch.Tensor:
    """Return the descriptors of all keypoints in the images of some scenes, and of their mirror images; a file keeps the first."""
    file = CACHE / f"{folder_of_keypoints(CACHE).name.replace('building', '-'.join(scenes))}.pt"
    if not file.exists():
        parts = list[torch.Tensor]()
        for scene in scenes:
            capture = capture_of(scene)
            names = [(split, name) for split in ("train", "test") for name in capture.frame_names(split)]
            for split, name in names:
                (image,) = detect_keypoints([without_depth(capture.views(split, [name])[0])], SIFT)
                parts.append(image.keypoints.descriptors)
        file.parent.mkdir(exist_ok=True)
        torch.save(torch.cat(parts), file)
    own = torch.load(file)
    bins = torch.arange(128).view(4, 4, 8)
    turns = torch.arange(8)
    mirrored = bins.flip(0)[:, :, -turns % 8].flatten()
    flipped = bins.flip(1)[:, :, (4 - turns) % 8].flatten()
    return torch.cat([own, own[:, mirrored], own[:, flipped], own[:, mirrored[flipped]]])


def elsewhere(own: LandmarkMap, descriptors: torch.Tensor, first: int) -> LandmarkMap:
    """Return landmarks with ``descriptors`` at random places, seen by images whose numbers begin at ``first``."""
    generator = torch.Generator().manual_seed(0)
    count = len(descriptors)
    chosen = torch.randint(len(own), (count,), generator=generator)
    spread = 100 * (own.positions - own.positions.mean(0)).norm(dim=-1).median()
    image = first + torch.arange(count) // IN_IMAGE
    order = torch.cat([image, image + 1, image + 2]).argsort(stable=True)
    tracks = Tracks(
        torch.arange(count).repeat(3)[order].int(),
        torch.cat([image, image + 1, image + 2])[order].int(),
        torch.zeros(3 * count, 2),
    )
    return replace(
        own[chosen],
        positions=own.positions.mean(0) + spread * torch.randn(count, 3, generator=generator),
        directions=torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1),
        descriptors=descriptors,
        descriptor_cells=None,
        tracks=tracks,
    )


def again(own: LandmarkMap, number: int, images: int) -> LandmarkMap:
    """Return a copy of landmarks at another place, with noise of its own in the descriptors and images of its own."""
    if own.tracks is None:
        raise SystemExit("the map has no tracks, expected one that was baked by this version")
    generator = torch.Generator().manual_seed(number)
    noise = 5.0 * torch.randn(own.descriptors.shape, generator=generator)
    extent = float((own.positions - own.positions.mean(0)).norm(dim=-1).max())
    return replace(
        own,
        positions=own.positions + torch.tensor([4.0 * extent * number, 0.0, 0.0]),
        descriptors=(own.descriptors + noise).round().clamp(0, 255).byte(),
        descriptor_cells=None,
        tracks=replace(own.tracks, image=own.tracks.image + number * images),
    )


def among_distractors(scene: str, folder: Path, size: int, copies: int, others: Sequence[str], frames: int) -> Row:
    """Store the map of a scene, which is there once or more often, with distractors up to ``size`` landmarks; return their number."""
    own = Scene.open(scene).map
    if own.landmarks is None:
        raise SystemExit(f"{scene}: a map without landmarks")
    images = len(own.info.cameras)
    many = distractors(others)
    base = own.landmarks
    if copies > 1:
        base = concatenate([again(own.landmarks, number, images) for number in range(copies)])
    some = torch.randperm(len(many), generator=torch.Generator().manual_seed(0))[: max(0, size - len(base))]
    if len(some):
        base = concatenate([base, elsewhere(own.landmarks, many[some], copies * images)])
    replace(own, landmarks=base.indexed()).save(folder, overwrite=True)
    return {"landmarks": len(base), "distractors": len(many)} | alone(ask_scene, folder, scene, frames)


def ask_scene(folder: Path, scene: str, frames: int) -> Row:
    """Localize test frames of a scene, without depth, in the map of a folder."""
    one_thread()
    return ask(folder, [without_depth(view) for view in Scene.open(scene).views(count=frames)])


def ask(folder: Path, views: Sequence[View]) -> Row:
    """Open the localizer of a map and localize the frames of ``views``."""
    before, began = memory()[0], time.process_time()
    localizer = Localizer(load_map(folder), warm_up=False)
    opened = time.process_time() - began
    localizer(views[0].frame)
    rows = [answer(lambda view=view: localizer(view.frame), view) for view in views]
    sizes = {"memory_MB": memory()[0] - before, "most_memory_MB": memory()[1] - before}
    return counts(rows) | {"opened_cpu_seconds": opened} | sizes


def search(others: Sequence[str], size: int, count: int = 500) -> Row:
    """Search the nearest descriptors of ``count`` others among ``size`` ones, by the index of maps and, if it is installed, by faiss.

    Both divide the descriptors, in bytes, into equally many cells, of which they search the twelve nearest.
    """
    one_thread()
    many = distractors(others)
    chosen = torch.randperm(len(many), generator=torch.Generator().manual_seed(0))[: size + count]
    known, queries = many[chosen[:size]], many[chosen[size:]]
    nearest = torch.cat([squared_distances(part, known).argmin(1) for part in queries.split(50)])
    began = time.process_time()
    cells = DescriptorCells.of(known)
    order = cells.cell.argsort(stable=True)
    index = InvertedFile(known[order], cells[order])
    rows = {"ours": {"build_cpu_seconds": time.process_time() - began}}
    began = time.process_time()
    found = order[index.nearest(queries, 1)[1][:, 0]]
    rows["ours"] |= {"cpu_ms": 1e3 * (time.process_time() - began) / count}
    rows["ours"] |= {"nearest_found": float((found == nearest).double().mean())}
    with contextlib.suppress(ImportError):
        import faiss  # type: ignore[import-not-found, unused-ignore]

        faiss.omp_set_num_threads(1)
        began = time.process_time()
        there = faiss.index_factory(known.shape[1], f"IVF{len(cells.centres)},SQ8_direct")
        there.by_residual = False  # bytes as they are
        there.train(known[: 20 * len(cells.centres)].float().numpy())
        for part in known.split(2**16):
            there.add(part.float().numpy())
        rows["faiss"] = {"build_cpu_seconds": time.process_time() - began}
        there.nprobe = 12
        began = time.process_time()
        numbers = there.search(queries.float().numpy(), 1)[1][:, 0]
        rows["faiss"] |= {"cpu_ms": 1e3 * (time.process_time() - began) / count}
        rows["faiss"] |= {"nearest_found": float((torch.from_numpy(numbers) == nearest).double().mean())}
    return {"descriptors": size, "cells": len(cells.centres)} | rows


# A building.


def measured(work: Callable[[], Result]) -> tuple[Result, Row]:
    """Return what a function returns, with its CPU time and the most memory of the process meanwhile."""
    Path("/proc/self/clear_refs").write_text("5")  # resets the maximum
    began = time.process_time()
    found = work()
    return found, {"cpu_seconds": time.process_time() - began, "most_memory_MB": memory()[1]}


def build(count: int, keypoints: Path, folder: Path) -> Row:
    """Build the landmarks of the building's first photos from their keypoints, and store a map of them."""
    one_thread()
    photos, images = Photos(count), keypoints_of(count, keypoints)
    _ = [photos[number] for number in held_out_images(count)]  # are rendered now
    views, config, rows = numbered(photos), DEFAULT_LANDMARKS, dict[str, Row]()
    pairs, rows["pairs"] = measured(lambda: likely_pairs(photos.poses, config.neighbours))
    tracked, rows["matches and tracks"] = measured(lambda: track_views(views, StoredKeypoints(images)))
    tracked = replace(tracked, features=USUAL_FEATURES)
    # Of a copy, since tracks keep what they have triangulated; these landmarks are not kept beside those of the trial
    _, rows["landmarks"] = measured(lambda: len(replace(tracked).landmarks(config)))
    landmarks, rows["trial"] = measured(lambda: tried_landmarks(tracked, photos, config))
    # Matching chooses the pairs again, and a trial builds the landmarks before.
    whole = rows["matches and tracks"]["cpu_seconds"] + rows["trial"]["cpu_seconds"]
    rows["matches and tracks"]["cpu_seconds"] -= rows["pairs"]["cpu_seconds"]
    rows["trial"]["cpu_seconds"] -= rows["landmarks"]["cpu_seconds"]
    lower, upper = bounds_of(0).lower, bounds_of(count // PHOTOS - 1).upper
    bounds = SceneBounds(lower, upper, 0.05, 2 * math.dist(lower, upper))
    info = MapInfo("", {}, bounds, 0, True, "building", cameras=stored_cameras(views), unit="metres")
    Map(info, NoField(), None, landmarks).save(folder, overwrite=True)
    return {
        "photos": count,
        "keypoints": sum(map(len, images)),
        "pairs": len(pairs),
        "landmarks": len(landmarks),
        "cpu_seconds_a_photo": whole / count,
        "most_memory_MB": max(row["most_memory_MB"] for row in rows.values()),
        "map_MB": sum(file.stat().st_size for file in folder.iterdir()) / 1e6,
        "trial": asdict(landmarks.trial),
        "steps": rows,
    }


def questions(rooms: int, count: int) -> list[tuple[int, View]]:
    """Return photos of random rooms that are not in the map, each with its room."""
    generator = torch.Generator().manual_seed(1)
    chosen = torch.randint(rooms, (count,), generator=generator).tolist()
    return [
        (room, photo(room, poses_in(room, count, 1)[number], f"new {number}")) for number, room in enumerate(chosen)
    ]


def ask_building(folder: Path, rooms: int, queries: int) -> Row:
    """Localize new photos of a building in the map of a folder."""
    one_thread()
    return ask(folder, [view for _, view in questions(rooms, queries)])


def exponent(rows: Sequence[Row], value: Callable[[Row], float]) -> float:
    """Return the exponent with which a value grows with the number of photos, by least squares in logarithms."""
    x, y = (torch.tensor([of(row) for row in rows]).double().log() for of in (lambda row: row["photos"], value))
    x = x - x.mean()
    return float((x * y).sum() / (x * x).sum())


def grown(rows: Sequence[Row]) -> dict[str, float]:
    """Return the exponents of the CPU time of each step and of all together, and of the memory."""
    found = {
        step: exponent(rows, lambda row, step=step: row["steps"][step]["cpu_seconds"])  # type: ignore[misc]
        for step in STEPS
    }
    together = exponent(rows, lambda row: row["cpu_seconds_a_photo"] * row["photos"])
    return found | {"all": together, "memory": exponent(rows, lambda row: row["most_memory_MB"])}


# Many maps.


def cut(scene: Map, count: int) -> dict[str, Map]:
    """Cut a map into maps of equally many successive photos, with the landmarks that these show first."""
    landmarks = scene.landmarks
    if landmarks is None or landmarks.tracks is None:
        raise SystemExit("the map has no tracks")
    tracks, cameras = landmarks.tracks, scene.info.cameras
    share = len(cameras) // count
    first = torch.full((len(landmarks),), len(cameras)).scatter_reduce(
        0, tracks.landmark.long(), tracks.image.long(), "amin"
    )
    found = {}
    for number in range(count):
        own = landmarks[(first // share == number).nonzero()[:, 0]]
        images = torch.full((len(cameras),), -1)
        images[number * share : (number + 1) * share] = torch.arange(share)
        own = replace(own, tracks=None if own.tracks is None else own.tracks.renumber(images=images))
        info = replace(scene.info, cameras=cameras[number * share : (number + 1) * share])
        found[f"part {number}"] = replace(scene, info=info, landmarks=own.indexed(), folder=None)
    return found


def ask_many_maps(folder: Path, rooms: int, queries: int) -> Row:
    """Localize new photos in all maps of a building's parts together, and each in the map of its part alone, in turn."""
    one_thread()
    asked = questions(rooms, queries)
    maps = cut(load_map(folder), MAPS)
    localizers = {name: Localizer(scene, warm_up=False) for name, scene in maps.items()}
    began = time.process_time()
    together = MapCollection(maps, localizers=localizers)
    opened = time.process_time() - began
    found, single, named = list[Row](), list[Row](), 0
    for room, view in asked:
        name = f"part {room * MAPS // rooms}"
        placement = None

        def place(view: View = view) -> Any:
            nonlocal placement
            placement = together(view.frame)
            return placement.found

        found.append(answer(place, view))
        single.append(answer(lambda view=view, name=name: localizers[name](view.frame), view))  # type: ignore[misc]
        named += placement is not None and placement.map == name
    ratio = statistics.median(row["cpu_seconds"] / own["cpu_seconds"] for row, own in zip(found, single, strict=True))
    return {"together": counts(found), "alone": counts(single), "right map": named} | {
        "times as long": ratio,
        "opened_cpu_seconds": opened,
    }


def main() -> None:
    given = parser(__doc__, "large")
    given.add_argument("scene", metavar="SCENE")
    given.add_argument(
        "--others", nargs="+", required=True, metavar="SCENE", help="other scenes, whose images give distractors"
    )
    given.add_argument("--work", type=Path, default=CACHE / "large", help="folder for maps (default: %(default)s)")
    given.add_argument("--frames", type=int, default=24)
    given.add_argument("--queries", type=int, default=200, help="photos that are localized in a building")
    given.add_argument("--photos", type=int, default=max(BUILDINGS), help="of the largest building")
    options = given.parse_args()
    one_thread()
    options.work.mkdir(parents=True, exist_ok=True)
    keypoints, buildings = folder_of_keypoints(CACHE), [count for count in BUILDINGS if count <= options.photos]
    results: dict[str, Any] = {}
    with RowStore(RESULTS / f"{options.name}.rows.jsonl") as store:

        def measure(title: str, work: Callable[[Path], Row], *key: Any) -> Row:
            results[title] = store.get(
                [title, *key], partial(work, options.work / title.replace(",", "").replace(" ", "-"))
            )
            print(title, json.dumps(results[title]), flush=True)
            return results[title]

        keypoints_of(max(buildings), keypoints)
        for count in buildings:
            folder = options.work / f"building-{count}"
            measure(f"{count:,} photos", lambda _, count=count, folder=folder: alone(build, count, keypoints, folder))  # type: ignore[misc]
        many = [
            (options.work / f"building-{count}", count // PHOTOS, options.queries)
            for count in sorted({min(CUT, buildings[-1]), buildings[-1]})
        ]
        for building in many:
            title = f"{building[1] * PHOTOS:,} photos, asked"
            measure(title, lambda _, building=building: alone(ask_building, *building), options.queries)  # type: ignore[misc]
        measure(f"{MAPS} maps", lambda _: alone(ask_many_maps, *many[0]), *many[0][1:])
        for title, size, copies in [
            *((f"{size:,} landmarks", size, 1) for size in SIZES),
            (f"{COPIES} times there", SIZES[-1], COPIES),
        ]:
            measure(
                title,
                lambda folder, size=size, copies=copies: alone(  # type: ignore[misc]
                    among_distractors, options.scene, folder, size, copies, options.others, options.frames
                ),
                *Scene.open(options.scene).key,
                options.frames,
            )
        measure("search", lambda _: alone(search, options.others, SIZES[-1]), *options.others)
    first, last = (results[f"{size:,} landmarks"] for size in (SIZES[0], SIZES[-1]))
    results["times as long"] = last["median_cpu_seconds"] / first["median_cpu_seconds"]
    results["accepted at the largest"] = asdict(success_rate(last["accepted"], last["n"]))
    results["exponents"] = grown([results[f"{count:,} photos"] for count in buildings])
    print(results["exponents"])
    record(options.name, results)


if __name__ == "__main__":
    main()
