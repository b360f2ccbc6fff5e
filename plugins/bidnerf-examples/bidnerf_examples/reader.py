"""Folders with a table of poses, as many small robots write them: ``poses.csv``, ``camera.json`` and images.

A row of ``poses.csv`` has the name of an image, its time in seconds, and the twelve numbers of the row-major
3 x 4 matrix ``T_world_camera`` (metres, x right, y down, z forward). Images are ``NAME.png`` with depth in
``NAME.depth.png`` (16 bits, millimetres, 0: not measured).
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from bidnerf_core import SE3, Dataset, Frame, FrameSequence, InputError, View
from bidnerf_core.datasets import (
    Background,
    FileSequence,
    Reader,
    ReadingProgress,
    ReadOptions,
    SequenceEntry,
)
from bidnerf_core.io import background_colour

TABLE, CAMERA = "poses.csv", "camera.json"


@dataclass(frozen=True)
class Row:
    """A row of the table."""

    name: str
    time: float
    T_world_camera: SE3


class PoseTable(Dataset):
    """The images of a folder, all in one split."""

    def __init__(self, path: Path, background: Background | None) -> None:
        self._path, self._rows = path, {row.name: row for row in read_table(path / TABLE)}
        self._background = background_colour("black" if background is None else background)

    @property
    def path(self) -> Path:
        return self._path

    @property
    def splits(self) -> tuple[str, ...]:
        return ("train",)

    @property
    def background(self) -> tuple[float, float, float]:
        return self._background

    def frame_names(self, split: str) -> list[str]:
        if split not in self.splits:
            raise InputError(f"no split {split!r}", where=self.path, expected="'train'")
        return list(self._rows)

    def views(
        self, split: str, names: Sequence[str] | None = None, progress: ReadingProgress | None = None
    ) -> list[View]:
        wanted = self.frame_names(split) if names is None else list(names)
        views = []
        for name in wanted:
            views.append(self.view(name))
            if progress is not None:
                progress(len(views), len(wanted))
        return views

    def view(self, name: str) -> View:
        """Read one image. Raises ``InputError`` for an unknown name."""
        if name not in self._rows:
            raise InputError(f"no image {name!r} in {TABLE}", where=self.path)
        frame = Frame.open(
            self.path / f"{name}.png",
            depth=self.path / f"{name}.depth.png",
            depth_unit=0.001,
            camera=self.path / CAMERA,
            background=self._background,
        )
        return View(frame, self._rows[name].T_world_camera)

    def sequence(self) -> FrameSequence:
        """Return the images in chronological order."""
        rows = sorted(self._rows.values(), key=lambda row: row.time)
        return FileSequence(
            self.path, [SequenceEntry(r.name, r.time, "train", self._reading(r)) for r in rows]
        )

    def _reading(self, row: Row) -> Callable[[], tuple[Frame, SE3]]:
        return lambda: (self.view(row.name).frame, row.T_world_camera)


class PoseTableReader(Reader):
    """The object that the entry point names."""

    expected = f"{TABLE} and {CAMERA} next to images"

    def recognises(self, path: Path) -> bool:
        return (path / TABLE).is_file() and (path / CAMERA).is_file()

    def open(self, path: Path, options: ReadOptions) -> PoseTable:
        return PoseTable(path, options.background)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        return PoseTable(path, options.background).sequence()


reader = PoseTableReader()


def read_table(file: Path) -> list[Row]:
    """Read the rows of ``poses.csv``. Raises ``InputError``, which names the line, for an invalid one."""
    found = []
    with file.open(newline="", encoding="utf-8") as opened:
        for number, cells in enumerate(csv.reader(opened), 1):
            try:
                name, *values = cells
                time, *matrix = map(float, values)
                rows = torch.tensor(matrix, dtype=torch.float64).reshape(3, 4)
            except (ValueError, RuntimeError) as error:
                raise InputError(f"line {number} is not a name and 13 numbers", where=file) from error
            pose = SE3(rows[:, :3], rows[:, 3])
            if not bool(pose.is_rigid()):
                raise InputError(f"line {number}: the pose of {name} is not a rigid transform", where=file)
            found.append(Row(name, time, pose.normalized()))
    return found
