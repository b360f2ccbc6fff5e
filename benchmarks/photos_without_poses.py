r"""Maps from photos whose poses are unknown, beside maps from the poses of a dataset.

    python benchmarks/photos_without_poses.py DATA --map MAP --out DIR --name NAME [--video] [--steps N] [--frames N]

The photos of all splits are taken without their poses, or written as a video; ``find_poses`` places them. The poses are
compared with those of the dataset after the similarity that best aligns the centres of the cameras. A map is then trained on
the photos that are in split "train" of the dataset, and the photos of split "test" (every eighth, where there is none) are
localized in it, and in the MAP that was trained with the poses of the dataset. Errors are in the units of the dataset.

Everything is kept in DIR: an interrupted run goes on from there.
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
import av
import numpy as np
import torch
from _lab import Row

import bidnerf as bn
from bidnerf import SE3, Frame, Map, View
from bidnerf.results import pose_error
from bidnerf_core.datasets import TimedFrame
from bidnerf_core.geometry import Similarity, fit_similarity
from bidnerf_core.io import to_plain
from bidnerf_core.progress import Progress

RATE = 30
"""Frames per second of a video that is made of photos."""


def main() -> None:
    parser = _lab.parser(__doc__)
    parser.add_argument("data", type=Path, metavar="DATA")
    parser.add_argument("--map", type=Path, help="map that was trained with the poses of the dataset")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--video", action="store_true", help="make a video of the photos")
    parser.add_argument("--steps", type=int, help="of training (default: those of the backend)")
    parser.add_argument("--frames", type=int, help="test photos, evenly spaced (default: all)")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    truth = {timed.frame.name: (timed.split, timed.truth) for timed in coloured(given.data) if timed.truth is not None}
    order = list(truth)
    source = written(given.data, given.out, given.video)
    known = given.out / "poses" / "poses.json"
    began = time.monotonic()
    found = bn.find_poses(source, given.out / "poses", progress=_quiet())
    result = without_files(to_plain(found)) | ({"seconds": time.monotonic() - began} if not known.exists() else {})
    placed = {v.frame.name: v for v in bn.open_dataset(given.out / "poses").views("all")}
    if given.video:  # frames are named by their numbers
        placed = {order[int(name)]: renamed(view, order[int(name)]) for name, view in placed.items()}
    names = [name for name in order if name in placed]
    align = fit_similarity(
        torch.stack([placed[name].T_ref_camera.translation for name in names]),
        torch.stack([truth[name][1].translation for name in names]),
    )
    result |= {"poses": compared([(placed[n].T_ref_camera, truth[n][1]) for n in names], align)}
    held = [name for name in order if truth[name][0] == "test"]
    training = [placed[name] for name in names if truth[name][0] != "test"]
    scene = trained(training, given.out / "map", given.steps)
    tested = held if given.frames is None else held[:: max(1, math.ceil(len(held) / given.frames))]
    queries = test_views(given.data, tested)
    result["localized"] = {"found": localized(scene, queries, align)}
    result["steps"], result["training_photos"] = scene.info.step, len(training)
    if given.map is not None:
        scene = bn.load_map(given.map)
        same = Similarity(1.0, SE3.identity(torch.float64))
        result["localized"]["given"] = localized(scene, queries, same)
        result["steps_given"] = scene.info.step
    print(json.dumps(result, indent=1))
    _lab.record(given.name, result)


def coloured(data: Path) -> list[TimedFrame]:
    """Return the frames of a sequence that have colours: phones record depth more often than photos."""
    return [timed for timed in bn.open_sequence(data) if timed.frame.has_colour]


def without_files(found: dict[str, Any]) -> dict[str, Any]:
    """Return what ``find_poses`` says without the places of the files on this machine."""
    left_out = [{key: each[key] for key in ("photo", "reason")} for each in found["left_out"]]
    return found | {"left_out": left_out}


def renamed(view: View, name: str) -> View:
    return replace(view, frame=view.frame.replace(name=name))


def _quiet() -> Any:
    last = [0.0]

    def show(now: Progress) -> None:
        if time.monotonic() - last[0] > 20:
            last[0] = time.monotonic()
            print(now, flush=True)

    return show


def written(data: Path, out: Path, video: bool) -> Path:
    """Return a folder of the photos, or a video of them in the order of time."""
    target = out / ("video.mp4" if video else "photos")
    if (out / "written").exists():
        return target
    if video:
        encode(target, [timed.frame for timed in coloured(data)])
    else:
        target.mkdir(exist_ok=True)
        images = [timed.frame for timed in coloured(data)]
        originals = {file.stem: file for file in data.rglob("*.jpg")}
        for frame in images:
            if frame.name in originals and not (target / f"{frame.name}.jpg").exists():
                (target / f"{frame.name}.jpg").symlink_to(originals[frame.name].resolve())
            elif frame.name not in originals:
                write_png(target / f"{frame.name}.png", frame)
    (out / "written").touch()
    return target


def write_png(path: Path, frame: Frame) -> None:
    import imageio.v3 as iio

    iio.imwrite(path, pixels(frame))


def pixels(frame: Frame) -> np.ndarray:
    return (frame.rgb * 255).round().byte().numpy()


def encode(path: Path, frames: Sequence[Frame]) -> None:
    camera = frames[0].intrinsics
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = camera.width, camera.height, "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels(frame), format="rgb24")))
        container.mux(stream.encode())


def aligned(T_world_camera: SE3, align: Similarity) -> SE3:
    """Return a pose in the frame of the dataset."""
    pose = T_world_camera.to("cpu", torch.float64)
    return SE3(align.T_target_source.rotation @ pose.rotation, align.apply(pose.translation))


def compared(pairs: Sequence[tuple[SE3, SE3]], align: Similarity) -> dict[str, Any]:
    """Return the errors of found poses against those of the dataset."""
    errors = [pose_error(aligned(found, align), truth) for found, truth in pairs]
    away = torch.tensor([float(error.translation) for error in errors])
    turned = torch.tensor([float(error.rotation_deg) for error in errors])
    return {
        "scale": align.scale,
        "translation": {"median": float(away.median()), "p90": float(away.quantile(0.9)), "max": float(away.max())},
        "rotation_deg": {
            "median": float(turned.median()),
            "p90": float(turned.quantile(0.9)),
            "max": float(turned.max()),
        },
    }


def trained(views: Sequence[View], folder: Path, steps: int | None) -> Map:
    """Return the map in ``folder``, trained on the views unless it is complete."""
    if (folder / "map.json").exists():
        scene = bn.load_map(folder)
        if scene.info.complete and scene.landmarks is not None:
            return scene
        del scene
        return bn.resume(folder, views, progress=_quiet())
    config = None if steps is None else {"steps": steps}
    return bn.train(views, out=folder, config=config, progress=_quiet())


def test_views(data: Path, names: Sequence[str]) -> list[View]:
    dataset = bn.open_dataset(data)
    return dataset.views("test", list(names))


def localized(scene: Map, queries: Sequence[View], align: Similarity) -> dict[str, Any]:
    """Return how photos without their poses are localized, in the frame of the dataset."""
    localizer, rows = bn.Localizer(scene), list[Row]()
    for number, view in enumerate(queries):
        found = localizer(view.frame.replace(depth=None), seed=number)
        error = pose_error(aligned(found.T_world_camera, align), view.T_ref_camera)
        finite = bool(found.T_world_camera.matrix().isfinite().all())
        rows.append(
            {
                "frame": view.frame.name,
                "converged": found.converged,
                "translation": float(error.translation) if finite else None,
                "rotation_deg": float(error.rotation_deg) if finite else None,
            }
        )
    wrong = [row["frame"] for row in rows if row["converged"] and not _lab.within(row)]
    return _lab.rates(rows) | {"accepted": sum(row["converged"] for row in rows), "accepted_wrong": wrong}


if __name__ == "__main__":
    main()
