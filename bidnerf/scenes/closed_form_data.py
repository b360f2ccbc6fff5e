"""Closed-form scenes as maps and datasets, so that an evaluation needs no files.

``demo:blobs`` is both a dataset and a map: coloured clouds whose field is known exactly, with images rendered
from it. ``demo:object`` and ``demo:room`` are the scenes of ``bidnerf demo`` and ``bidnerf.scenes`` with
exact depth, as datasets for training maps and localizing in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch

from bidnerf.scenes.closed_form import look_around, orbit
from bidnerf.scenes.demo import demo_object, demo_room
from bidnerf.scenes.fields import GaussianBlobs
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import Capture, FrameShot
from bidnerf_core.errors import UsageError
from bidnerf_core.fields import SceneBounds, render_image
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.maps import Map, MapInfo

PREFIX = "demo:"
DEMO_CAMERA = Intrinsics(175.0, 175.0, 64.0, 64.0, 128, 128)
FRAME_COUNT = 24


def is_closed_form(name: str) -> bool:
    """Return whether a name is that of a closed-form scene rather than a folder."""
    return name.startswith(PREFIX)


def closed_form_data(name: str) -> Capture:
    """Return the dataset ``demo:NAME``: split "test" and, if the scene has frames to train on, split "train".

    Raises ``UsageError`` for an unknown name.
    """
    _check(name, ("blobs", "object", "room"), "data")
    training = list[SE3]()
    if name == "demo:blobs":
        poses, render, background = orbit(3.5, FRAME_COUNT, seed=1), _render_blobs, BLOBS.background
    else:
        is_room = name == "demo:room"
        scene = demo_room() if is_room else demo_object()
        poses, training = orbit(3.5, FRAME_COUNT, elevation=(15.0, 50.0), seed=1), orbit(3.5, 40)
        if is_room:
            poses, training = look_around(scene.bounds, FRAME_COUNT, seed=1), look_around(scene.bounds, 40)
        render, background = partial(scene.render, DEMO_CAMERA), scene.bounds.background
    shots = [
        FrameShot(make=partial(render, pose), T_world_camera=pose, splits=(split,), stem=f"{number:04d}")
        for split, group in (("train", training), ("test", poses))
        for number, pose in enumerate(group)
    ]
    return Capture(Path(name), shots, background)


def closed_form_map(name: str) -> Map:
    """Return the map ``demo:NAME``. Raises ``UsageError`` for a name whose field is not known in closed form."""
    _check(name, ("blobs",), "map")
    return Map(MapInfo("closed-form", {}, BLOBS, 0, True, "demo:blobs", weights="exact", unit="metres"), BLOB_FIELD)


def _check(name: str, known: Sequence[str], what: str) -> None:
    if name.removeprefix(PREFIX) not in known:
        listed = " or ".join(PREFIX + one for one in known)
        raise UsageError(
            f"no closed-form {what} {name!r}", expected=f"{listed}; 'bidnerf demo' trains maps of the others"
        )


BLOBS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 12.0, (1.0, 1.0, 1.0))
BLOB_FIELD = GaussianBlobs.random(count=7, seed=3, density=400.0)


def _render_blobs(T: SE3, name: str) -> Frame:
    half = Intrinsics(87.5, 87.5, 32.0, 32.0, 64, 64)
    image = render_image(BLOB_FIELD, half, T, BLOBS)
    depth = torch.where(image.opacity > 0.99, image.depth, 0)  # only nearly opaque pixels have depth
    return Frame(name, image.rgb, half, depth, image.opacity)
