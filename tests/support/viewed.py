"""What tests of the viewer share: a map of a room with patterned walls, and a photo of it that is localized by landmarks."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from PIL import Image

from bidnerf import SE3, Frame, TrainOptions, View, train
from bidnerf_core.datasets import Query
from bidnerf_core.mapping import BakeConfig
from optional import require
from photo_room import CAMERA, photograph, room_depth
from photo_room import walk as walk
from tiny import config

HOSTILE = "<script>document.title = 'run'</script>"


def posed(T: SE3, name: str, seed: int = 0) -> View:
    """Return a photo of the room with exact depth."""
    depth = room_depth(T).numpy()
    return View(Frame.from_numpy(photograph(T, seed), CAMERA, depth=depth, depth_unit=1.0, name=name), T)


def make_room(folder: Path) -> None:
    """Train a map of the room for two steps into ``folder / "map"``, and bake it."""
    views = [posed(T, f"view {number}") for number, T in enumerate(walk(8))]
    bake = BakeConfig(cells=20_000)
    train(
        views,
        backend="hashgrid",
        out=folder / "map",
        config=config(2),
        bake=bake,
        options=TrainOptions(refine_poses="never"),
    )


def query(name: str = "unseen", seed: int = 0) -> Query:
    """Return a photo from between two of those of the map; another ``seed`` is another room."""
    view = posed(walk(15)[7], name, seed)
    return Query(name, (view,), view.T_ref_camera)


def photo_file(folder: Path, name: str = "photo.png") -> Path:
    """Write a photo of the room to a file without a focal length."""
    file = folder / name
    Image.fromarray(photograph(walk(15)[5])).save(file)
    return file


def state_of(page: str) -> Any:
    """Return the state that a page holds."""
    found = require(re.search(r'<script type="application/json" id="state">(.*?)</script>', page, re.DOTALL))
    return json.loads(found[1])
