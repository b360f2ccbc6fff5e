"""A photo that came with a request: its bytes, and what is known about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets import Photos
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Background, is_heif, read_array, read_header
from bidnerf_core.results import read_pose

NUMPY = b"\x93NUMPY"


@dataclass(frozen=True)
class Upload:
    """A photo and what is known about it, as sent with a request: no value is ever used as a file name."""

    parameters: Mapping[str, Any]
    blocks: Mapping[str, bytes]

    @property
    def name(self) -> str:
        """The name of the frame in the answer."""
        return str(self.parameters.get("name") or "photo")

    @property
    def seed(self) -> int:
        """The seed of the search."""
        return int(self.parameters.get("seed") or 0)

    def read(
        self, usual: CameraSource, background: Background | None, folder: Path, max_pixels: float
    ) -> tuple[Photos, SE3 | None]:
        """Write the files into ``folder``, check the sizes in their headers, and return the photo and the start.

        ``usual`` is the camera of photos that come without one, and ``background`` is what lies behind transparent pixels.
        """
        photo = _written(folder, "photo", self.blocks["photo"])
        _check_size(photo, max_pixels)
        depth = _written(folder, "depth", self.blocks["depth"]) if "depth" in self.blocks else None
        if depth is not None:
            _check_size(depth, max_pixels)
        unit = self.parameters.get("depth_unit")
        if unit is not None and depth is None:
            raise InputError(
                "depth_unit was given without depth", expected="the depth image that it belongs to"
            )
        focal, hfov = self.parameters.get("focal"), self.parameters.get("hfov")
        own = CameraSource(self._file(folder, "camera"), focal, hfov, usual.assumed)
        camera = own if own.is_given else usual
        photos = Photos([photo], camera, {} if depth is None else {photo: depth}, unit, background=background)
        start = self._file(folder, "start")
        return photos, None if start is None else read_pose(start)

    def _file(self, folder: Path, name: str) -> Path | None:
        if name not in self.blocks:
            return None
        file = folder / name
        file.write_bytes(self.blocks[name])
        return file


def _written(folder: Path, name: str, content: bytes) -> Path:
    """Write an image under a name with the extension that readers expect."""
    ending = ".npy" if content.startswith(NUMPY) else ""
    if is_heif(content):
        ending = ".heic"
    file = folder / f"{name}{ending}"
    file.write_bytes(content)
    return file


def _check_size(file: Path, max_pixels: float) -> None:
    """Raise ``InputError`` for an image that is too large to be decoded; an array is as large as its file."""
    if file.suffix == ".npy":
        read_array(file, "a .npy file")
        return
    header = read_header(file)
    if header.width * header.height > max_pixels:
        raise InputError(
            f"image is {header.width}x{header.height}",
            where=file,
            expected=f"at most {max_pixels / 1e6:g} megapixels",
        )
