"""The single camera of a recording whose format has none in its files."""

from __future__ import annotations

from pathlib import Path

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.orientation import UPRIGHT
from bidnerf_core.camera.source import Raster, read_camera
from bidnerf_core.errors import InputError

CAMERA_FILES = ("camera.json", "cameras.txt")
"""Files in a recording's folder that may hold its camera, in the formats of ``read_camera``."""


class FolderCamera:
    """The camera ``given`` (intrinsics or a file), or that of a file in ``folder``, or the ``published`` one of the format.

    Raises ``InputError`` where none of them exists, with the reason ``unknown`` and the ``ways`` to give one, and for a given
    file that does not exist.
    """

    def __init__(
        self,
        folder: Path,
        given: Intrinsics | Path | None,
        published: Intrinsics | None,
        unknown: str = "",
        ways: str = "a file",
    ) -> None:
        if isinstance(given, Path) and not given.exists():
            raise InputError(f"{given}: no such file, expected as the camera of {folder}: {ways}")
        beside = next((folder / name for name in CAMERA_FILES if (folder / name).is_file()), None)
        found = given or beside or published
        if found is None:
            raise InputError(
                f"{folder}: {unknown}; expected its camera: {' or '.join(CAMERA_FILES)} in the folder, or --camera with "
                f"{ways} (camera= in Python)"
            )
        self._source = found

    def at(self, image: Path, width: int, height: int) -> Intrinsics:
        """Return the camera at the size of an image. Raises ``InputError`` if their aspect ratios differ."""
        camera = (
            self._source
            if isinstance(self._source, Intrinsics)
            else read_camera(self._source, (width, height))
        )
        fitted = Raster(width, height, UPRIGHT).upright(camera)
        if fitted is None:
            raise InputError(
                f"{image}: image is {width}x{height}, its camera is for {camera.width}x{camera.height}; "
                "expected one of the same aspect ratio"
            )
        return fitted
