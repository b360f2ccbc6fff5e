"""A folder in which the commands and programs of the documentation run: tiny files under the names that it uses."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from PIL.ExifTags import Base

import tiny
from bidnerf.scenes import demo_object, orbit
from bidnerf.scenes import views as views_of
from bidnerf_core.backend import load_backend
from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import stored_cameras
from bidnerf_core.datasets import write_transforms
from bidnerf_core.frames import View
from bidnerf_core.io import to_plain
from bidnerf_core.localization import Outcome
from bidnerf_core.mapping import BakeConfig, bake
from bidnerf_core.maps import MapInfo, write_parts
from bidnerf_core.training import Silent, TrainingState

TEST_FRAMES = ("r_0", "r_4", "r_8")
PHOTO_CAMERA = Intrinsics(32.0, 32.0, 12.0, 12.0, 24, 24)
EQUIVALENT_MM = 41  # on 35 mm film, about the focal length of that camera


def fill(folder: Path) -> None:
    """Write DATA, SCAN, MAP, MAP2, MAPS/, photo.jpg, depth.png, photos/, camera.json, pose.json and poses.json into ``folder``."""
    train, test = tiny.views(8), named(tiny.views(3, seed=1))
    write_transforms(folder / "DATA", {"train": train, "test": test}, tiny.BACKGROUND)
    write_map(folder / "MAP", train)
    shutil.copytree(folder / "MAP", folder / "MAP2")
    shutil.copytree(folder / "MAP", folder / "MAPS" / "hall")
    write_photo(folder / "photo.jpg", test[0])
    write_depth(folder / "depth.png", test[0])
    for number, view in enumerate(test[:2]):
        write_photo(folder / "photos" / f"{number}.jpg", view)
    write_scan(folder / "SCAN", test)
    pose = test[0].T_ref_camera.matrix().tolist()
    (folder / "pose.json").write_text(json.dumps({"T_world_camera": pose, "outcome": Outcome.CONVERGED}))
    both = [{"frame": f"{number}", "T_world_camera": pose} for number in range(2)]
    (folder / "poses.json").write_text(json.dumps(both))
    camera = PHOTO_CAMERA
    intrinsics = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "w": 24, "h": 24}
    (folder / "camera.json").write_text(json.dumps(intrinsics))


def write_scan(folder: Path, views: list[View]) -> None:
    """Write photos with a table of world-to-camera poses, the format of the documentation's example of a reader."""
    rows = []
    for view in views:
        write_photo(folder / f"{view.frame.name}.jpg", view)
        numbers = view.T_ref_camera.inverse().matrix()[:3].flatten().tolist()
        rows.append(",".join([f"{view.frame.name}.jpg", *map(repr, numbers)]))
    (folder / "poses.csv").write_text("\n".join(rows) + "\n")


def named(views: list[View]) -> list[View]:
    """Return the views with the names of test frames."""
    frames = [dataclasses.replace(v.frame, name=name) for v, name in zip(views, TEST_FRAMES, strict=True)]
    return [View(frame, v.T_ref_camera) for frame, v in zip(frames, views, strict=True)]


def write_map(folder: Path, views: list[View]) -> None:
    """Train a tiny field for a few steps, and bake a surface from the exact depth of the views."""
    bounds, config, backend = demo_object().bounds, tiny.config(), load_backend("hashgrid")
    field = backend.build(config, bounds)
    backend.train(field, views, config, Silent())
    info = MapInfo("hashgrid", to_plain(config), bounds, config.steps, complete=True, cameras=stored_cameras(views))
    state = TrainingState(config.steps, dict(field.state_dict()), {})
    seen = views_of(demo_object(), tiny.CAMERA, orbit(3.5, 12))
    surface = bake(field, bounds, [], seen, BakeConfig(rays=6_000, cells=6_000))
    write_parts(folder, info, state, surface)


def write_photo(path: Path, view: View) -> None:
    """Write a JPEG with a focal length in EXIF."""
    path.parent.mkdir(exist_ok=True)
    exif = Image.Exif()
    exif[Base.FocalLengthIn35mmFilm] = EQUIVALENT_MM
    pixels = (view.frame.rgb * 255).round().to(torch.uint8).numpy()
    Image.fromarray(pixels).save(path, quality=95, exif=exif)


def write_depth(path: Path, view: View) -> None:
    """Write a 16-bit PNG of millimetres."""
    assert view.frame.depth is not None
    Image.fromarray((view.frame.depth * 1000).round().numpy().astype(np.uint16)).save(path)
