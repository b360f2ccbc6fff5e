"""Closed-form scenes as maps and datasets, so that an evaluation needs no files.

``demo:blobs`` is both a dataset and a map: coloured clouds whose field is known exactly, with images rendered
from it. ``demo:object`` and ``demo:room`` are the scenes of ``bidnerf demo`` and ``bidnerf_core.scenes`` with
exact depth, as datasets for training maps and localizing in them.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import ReadingProgress
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds, render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, turned_about
from bidnerf_core.maps import Map, MapInfo
from bidnerf_core.scenes.demo import demo_object, demo_room
from bidnerf_core.scenes.fields import GaussianBlobs
from bidnerf_core.scenes.trajectories import look_around, orbit

PREFIX = "demo:"
DEMO_CAMERA = Intrinsics(175.0, 175.0, 64.0, 64.0, 128, 128)
FRAMES, TRAINING_FRAMES = 24, 40
BLOBS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 12.0, (1.0, 1.0, 1.0))
FRAME_NAME = re.compile(r"(?P<place>\d{4})(?:@(?P<angle>-?\d+(?:\.\d+)?))?")
"""A frame's name: its number and, in a sequence, the angle in degrees by which it is rotated."""

Scene = TypeVar("Scene")
Render = Callable[[SE3, str], Frame]


@dataclass(frozen=True, eq=False)
class ClosedFormData:
    """A ``Dataset`` with split "test", and split "train" if ``training`` has poses.

    Frame "0003@15" is frame 0003 rotated by 15 degrees about the middle.
    """

    name: str
    poses: tuple[SE3, ...]  # T_world_camera
    render: Render
    background: tuple[float, float, float]
    middle: tuple[float, float, float] = (0.0, 0.0, 0.0)  # metres, world
    training: tuple[SE3, ...] = ()  # T_world_camera

    @property
    def path(self) -> Path:
        """The name of the scene, in place of a folder."""
        return Path(PREFIX + self.name)

    @property
    def splits(self) -> tuple[str, ...]:
        """The names of all splits."""
        return ("train", "test") if self.training else ("test",)

    def frame_names(self, split: str) -> list[str]:
        """Return the names of the frames of ``split``."""
        return [f"{place:04d}" for place in range(len(self._poses(split)))]

    def _poses(self, split: str) -> tuple[SE3, ...]:
        if split not in self.splits:
            raise InputError(f"no split {split!r}", where=self.path, expected=" or ".join(self.splits))
        return self.poses if split == "test" else self.training

    def views(
        self, split: str, names: Sequence[str] | None = None, progress: ReadingProgress | None = None
    ) -> list[View]:
        """Render the frames with these names, by default all of the split."""
        asked, views = self.frame_names(split) if names is None else names, []
        for done, name in enumerate(asked, start=1):
            pose = self._pose(name, split)
            views.append(View(self.render(pose, name), pose))
            if progress is not None:
                progress(done, len(asked))
        return views

    def sequence(self, name: str, count: int, angle: float) -> tuple[str, ...]:
        """Return the names of ``count`` frames, ``angle`` degrees apart, ending with frame ``name``."""
        return (*(f"{name}@{k * angle:g}" for k in range(count - 1, 0, -1)), name)

    def _pose(self, name: str, split: str) -> SE3:
        found, poses = FRAME_NAME.fullmatch(name), self._poses(split)
        if found is None or int(found["place"]) >= len(poses):
            last = len(poses) - 1
            raise InputError(
                f"no frame {name!r}",
                where=self.path,
                expected=f"0000 to {last:04d} or a name such as 0000@15",
            )
        pose, up = poses[int(found["place"])], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        return turned_about(
            pose, torch.tensor(self.middle, dtype=torch.float64), up, float(found["angle"] or 0)
        )


def is_closed_form(name: str) -> bool:
    """Return whether a name is that of a closed-form scene rather than a folder."""
    return name.startswith(PREFIX)


def closed_form_data(name: str) -> ClosedFormData:
    """Return the data of ``demo:NAME``. Raises ``InputError`` for an unknown name."""
    return _found(name, DATA, "data")()


def closed_form_map(name: str) -> Map:
    """Return the map of ``demo:NAME``. Raises ``InputError`` for a name whose field is not known in closed form."""
    return _found(name, MAPS, "map")()


def _found(name: str, known: dict[str, Callable[[], Scene]], what: str) -> Callable[[], Scene]:
    own = name.removeprefix(PREFIX)
    if own in known:
        return known[own]
    listed = " or ".join(PREFIX + one for one in known)
    if own in DATA:
        raise InputError(f"has no map; train one with 'bidnerf demo', or use {listed}", where=name)
    near = difflib.get_close_matches(own, known, n=1)
    raise InputError(f"no closed-form {what} {name!r}", expected=PREFIX + near[0] if near else listed)


def _object() -> ClosedFormData:
    scene = demo_object()
    poses = tuple(orbit(3.5, FRAMES, elevation=(15.0, 50.0), seed=1))
    training = tuple(orbit(3.5, TRAINING_FRAMES))
    return ClosedFormData(
        "object",
        poses,
        lambda T, name: scene.render(DEMO_CAMERA, T, name),
        scene.bounds.background,
        training=training,
    )


def _room() -> ClosedFormData:
    scene = demo_room()
    middle = (0.0, 0.0, 1.25)
    poses = tuple(look_around(scene.bounds, FRAMES, seed=1))
    training = tuple(look_around(scene.bounds, TRAINING_FRAMES))
    return ClosedFormData(
        "room",
        poses,
        lambda T, name: scene.render(DEMO_CAMERA, T, name),
        scene.bounds.background,
        middle,
        training,
    )


def _blobs() -> ClosedFormData:
    field, half = _blob_field(), Intrinsics(87.5, 87.5, 32.0, 32.0, 64, 64)

    def render(T: SE3, name: str) -> Frame:
        image = render_image(field, half, T, BLOBS)
        depth = torch.where(image.opacity > 0.99, image.depth, 0)  # only nearly opaque pixels have depth
        return Frame(name, image.rgb, half, depth, image.opacity)

    return ClosedFormData("blobs", tuple(orbit(3.5, FRAMES, seed=1)), render, BLOBS.background)


def _blob_field() -> GaussianBlobs:
    return GaussianBlobs.random(count=7, seed=3, density=400.0)


def _blob_map() -> Map:
    info = MapInfo("closed-form", {}, BLOBS, 0, True, "demo:blobs", weights="exact", unit="metres")
    return Map(info, _blob_field())


DATA: dict[str, Callable[[], ClosedFormData]] = {"blobs": _blobs, "object": _object, "room": _room}
MAPS: dict[str, Callable[[], Map]] = {"blobs": _blob_map}
