"""What queries of large maps take, and whether a scene that is there ten times is refused.

    python benchmarks/large.py MAP:DATA --others DATA [DATA ...] [--work large] [--frames 24]

The landmarks of a map are joined with distractors: the descriptors of all keypoints in the images of other scenes, as they are, mirrored
and turned by 180 degrees (a permutation of the channels of SIFT), at random places, each seen in three images. Localizers are opened,
and asked for test frames without depth, in a process of their own for each size. The script resumes from ``WORK/rows.jsonl``.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch
from _lab import Row, RowStore, Scene, answer, one_thread, parser, record, within, without_depth

from bidnerf import SE3, Localizer, load_map, open_dataset
from bidnerf.results import success_rate
from bidnerf_core.frames import View
from bidnerf_core.mapping import LandmarkMap, Sift, Tracks, concatenate, detect_keypoints

SIZES = (10_000, 100_000, 1_000_000)
COPIES = 10
IN_IMAGE = 700
"""Number of distractors that appear in an image for the first time."""


def distractors(datasets: list[Path], file: Path) -> torch.Tensor:
    """Return the descriptors of all keypoints in the images of some datasets, and of their mirror images; ``file`` keeps the first."""
    if not file.exists():
        parts = list[torch.Tensor]()
        for folder in datasets:
            capture = open_dataset(folder)
            names = [(split, name) for split in ("train", "test") for name in capture.frame_names(split)]
            for split, name in names:
                (image,) = detect_keypoints([without_depth(capture.views(split, [name])[0])], Sift())
                parts.append(image.keypoints.descriptors)
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


def memory() -> tuple[float, float]:
    """Return the memory that this process takes, and the most that it has taken, MB (of Linux)."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(status["VmRSS"].split()[0]) / 1e3, float(status["VmHWM"].split()[0]) / 1e3


def ask(folder: Path, data: Path, names: list[str]) -> Row:
    """Open the localizer of a map and localize test frames without depth, in this process."""
    one_thread()
    views = [without_depth(view) for view in open_dataset(data).views("test", names)]
    before, began = memory()[0], time.process_time()
    localizer = Localizer(load_map(folder), warm_up=False)
    opened = time.process_time() - began
    localizer(views[0].frame)
    rows = [answer(lambda view=view: localizer(View(view.frame, SE3.identity()).frame), view) for view in views]
    accepted = [row for row in rows if row["converged"]]
    return {
        "n": len(rows),
        "right": sum(map(within, rows)),
        "accepted": len(accepted),
        "silent": sum(not within(row) for row in accepted),
        "ambiguous": sum(row["outcome"] == "ambiguous" for row in rows),
        "median_cpu_seconds": statistics.median(row["cpu_seconds"] for row in rows),
        "opened_cpu_seconds": opened,
        "memory_MB": memory()[0] - before,
        "most_memory_MB": memory()[1] - before,
    }


def main() -> None:
    given = parser(__doc__, "large")
    given.add_argument("scene", metavar="MAP:DATA")
    given.add_argument("--others", nargs="+", type=Path, required=True, metavar="DATA", help="datasets of other scenes")
    given.add_argument("--work", type=Path, default=Path("large"), help="folder for maps and rows")
    given.add_argument("--frames", type=int, default=24)
    given.add_argument("--ask", nargs="+", help="internal: map, dataset and names of frames")
    options = given.parse_args()
    if options.ask:
        folder, data, *names = options.ask
        print(json.dumps(ask(Path(folder), Path(data), names)))
        return
    options.work.mkdir(parents=True, exist_ok=True)
    scene = Scene.open(options.scene)
    own, images = scene.map.landmarks, len(scene.map.info.cameras)
    if own is None:
        raise SystemExit(f"{scene.folder}: a map without landmarks")
    names = [view.frame.name for view in scene.views(count=options.frames)]
    many = distractors(options.others, options.work / "descriptors.pt")
    many = many[torch.randperm(len(many), generator=torch.Generator().manual_seed(0))]
    copies = concatenate([again(own, number, images) for number in range(COPIES)])
    results: dict[str, Any] = {"distractors": len(many)}
    with RowStore(options.work / "rows.jsonl") as store:
        for title, base, size in [
            *((f"{size:,} landmarks", own, size) for size in SIZES),
            (f"{COPIES} times there", copies, SIZES[-1]),
        ]:

            def measure(base: LandmarkMap = base, size: int = size, title: str = title) -> Row:
                more = elsewhere(own, many[: max(0, size - len(base))], COPIES * images)
                whole = concatenate([base, more]) if len(more) else base
                folder = options.work / title.replace(",", "").replace(" ", "-")
                replace(scene.map, landmarks=whole.indexed()).save(folder, overwrite=True)
                words = [
                    sys.executable,
                    __file__,
                    options.scene,
                    "--others",
                    "-",
                    "--ask",
                    str(folder),
                    str(scene.data),
                    *names,
                ]
                done = subprocess.run(words, check=True, capture_output=True, text=True)
                return {"landmarks": len(whole)} | json.loads(done.stdout)

            results[title] = store.get([title, *scene.key, len(names)], measure)
            print(title, results[title], flush=True)
    first, last = (results[f"{size:,} landmarks"] for size in (SIZES[0], SIZES[-1]))
    results["times as long"] = last["median_cpu_seconds"] / first["median_cpu_seconds"]
    results["accepted at the largest"] = asdict(success_rate(last["accepted"], last["n"]))
    record(options.name, results)


if __name__ == "__main__":
    main()
