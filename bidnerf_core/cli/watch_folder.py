"""``bidnerf track --follow``: frames that arrive one by one, in a watched folder or as JSON lines on stdin."""

from __future__ import annotations

import sys
import time as clocks
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

from bidnerf_core.errors import InputError

if TYPE_CHECKING:
    from bidnerf_core.datasets import DatasetOptions
    from bidnerf_core.depth import DepthCamera
    from bidnerf_core.frames import Frame

STDIN = "-"
POLL = 0.05
"""Seconds between two checks of a watched folder."""


@dataclass(frozen=True)
class FrameRequest:
    """A frame to read."""

    image: Path
    depth: Path | None = None
    time: float | None = None  # seconds
    depth_unit: float | None = None  # metres per step
    mask: Path | None = None  # black is ignored

    @staticmethod
    def parse(line: str) -> FrameRequest:
        """Parse the request in a line ``{"image": path, "depth": path, "time": s}``; only the image is required."""
        from bidnerf_core.io import parse_record

        request = parse_record("request", line, '{"image": path, "depth": path, "time": seconds}')
        image, depth = request.text("image"), request.text("depth")
        if image is None:
            raise request.error(f'no "image" in {line.strip()[:80]!r}')
        keys = {field.name for field in fields(FrameRequest)}
        if unknown := sorted(request.values.keys() - keys):
            raise request.error(f"unknown key {unknown[0]!r}", expected=f"any of {', '.join(sorted(keys))}")
        mask = request.text("mask")
        return FrameRequest(
            Path(image),
            None if depth is None else Path(depth),
            request.number("time"),
            request.number("depth_unit"),
            None if mask is None else Path(mask),
        )

    def read(self, images: DatasetOptions, sensor: DepthCamera | None) -> Frame:
        """Read the image and its depth. Raises ``InputError`` if they cannot be read or the camera is unknown."""
        from bidnerf_core.frames import Frame

        return Frame.read(
            self.image, images.camera_source, depth=self.depth, depth_unit=self.depth_unit, sensor=sensor,
            background=images.background, mask=self.mask,
        )  # fmt: skip


def requests(source: str) -> Iterator[FrameRequest | InputError]:
    """Yield frames as they arrive: lines of stdin until it ends, or the images of a folder until the program is stopped.

    A line that is not a request is yielded as the error with which to answer it.
    """
    if source != STDIN:
        yield from _arriving(Path(source))
        return
    for line in iter(sys.stdin.readline, ""):  # iterating over stdin itself would wait for a full buffer
        if not line.strip():
            continue
        try:
            yield FrameRequest.parse(line)
        except InputError as error:
            yield error


def _arriving(folder: Path) -> Iterator[FrameRequest]:
    """Yield the images of a folder in natural name order, and later ones as they arrive."""
    from bidnerf_core.frames import photos_in
    from bidnerf_core.io import IMAGE_SUFFIXES

    if not folder.is_dir():
        raise InputError(
            "no such folder", where=folder, expected=f"one that receives images, or {STDIN} for stdin"
        )
    given, sizes = set[Path](), dict[Path, tuple[int, int]]()
    while True:
        photos, others = photos_in(folder)
        waiting = [photo for photo in photos if photo not in given]
        for photo in waiting:
            # Files of other kinds hold something else about the photo, such as NAME.json.
            depths = [
                file for file in others
                if file.name.startswith(f"{photo.stem}.") and file.suffix.lower() in (".npy", *IMAGE_SUFFIXES)
            ]  # fmt: skip
            if not all(_is_steady(file, sizes) for file in (photo, *depths[:1])):
                break  # later names have to wait, to keep the name order
            given.add(photo)
            yield FrameRequest(photo, depths[0] if depths else None)
        clocks.sleep(POLL)


def _is_steady(file: Path, sizes: dict[Path, tuple[int, int]]) -> bool:
    """Return whether the size of a file, which may still be being written, has stayed the same for two checks."""
    try:
        size = file.stat().st_size
    except OSError:
        return False
    before, looks = sizes.get(file, (-1, 0))
    looks = looks + 1 if size == before and size > 0 else 0
    sizes[file] = (size, looks)
    return looks >= 2
