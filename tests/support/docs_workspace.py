"""A folder in which the commands and programs of the documentation run: tiny files under the names that it uses."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import tiny
from bidnerf import Outcome, TrainOptions, train
from bidnerf_core.datasets import write_transforms
from bidnerf_core.mapping import BakeConfig
from photo_files import write_photo
from scan_layouts import camera_keys, millimetres, pixels, write_image

TEST_FRAMES = ("r_0", "r_4", "r_8")
EQUIVALENT_MM = 41  # on 35 mm film, about the focal length of ``tiny.CAMERA``


def fill(folder: Path) -> None:
    """Write DATA, SCAN, MAP, MAP2, MAPS/, PROJECT/, photos/, and files such as photo.jpg and camera.json into ``folder``."""
    seen = zip(tiny.views(3, seed=1), TEST_FRAMES, strict=True)
    test = [replace(view, frame=replace(view.frame, name=name)) for view, name in seen]
    write_transforms(folder / "DATA", {"train": tiny.views(8), "test": test}, tiny.BACKGROUND)
    bake, plain = BakeConfig(rays=6_000, cells=6_000), TrainOptions(refine_poses="never")
    train(folder / "DATA", backend="hashgrid", out=folder / "MAP", config=tiny.config(), bake=bake, options=plain)
    shutil.copytree(folder / "MAP", folder / "MAP2")
    shutil.copytree(folder / "MAP", folder / "MAPS" / "hall")
    write_image(folder / "depth.png", millimetres(test[0]))
    for name, view in zip(("photo.jpg", "photos/0.jpg", "photos/1.jpg"), (test[0], *test), strict=False):
        write_photo(folder / name, pixels(view), FocalLengthIn35mmFilm=EQUIVALENT_MM)
    rows = []
    for view in test:  # photos with a table of world-to-camera poses, as in the documentation's example of a reader
        write_photo(folder / f"SCAN/{view.frame.name}.jpg", pixels(view), FocalLengthIn35mmFilm=EQUIVALENT_MM)
        numbers = view.T_ref_camera.inverse().matrix()[:3].flatten().tolist()
        rows.append(",".join([f"{view.frame.name}.jpg", *map(repr, numbers)]))
    (folder / "SCAN/poses.csv").write_text("\n".join(rows) + "\n")
    pose = test[0].T_ref_camera.matrix().tolist()
    both = [{"frame": f"{number}", "T_world_camera": pose} for number in range(2)]
    plain_files = {
        "pose.json": {"T_world_camera": pose, "outcome": Outcome.CONVERGED},
        "poses.json": both,
        "camera.json": camera_keys(tiny.CAMERA),
    }
    for name, content in plain_files.items():
        (folder / name).write_text(json.dumps(content))
    # What commands name that are only parsed.
    for name in ("PROJECT", "new-photos"):
        (folder / name).mkdir()
    for name in ("splat.ply", "RESULTS.jsonl", "results.jsonl", "known.json", "page.html"):
        (folder / name).touch()
