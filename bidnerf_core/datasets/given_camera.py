"""The camera of images that have no description beside them, as a user gives it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.camera import Intrinsics
from bidnerf_core.camera_sources import WAYS, CameraSource, Raster, find_camera
from bidnerf_core.errors import InputError
from bidnerf_core.exif import Exif
from bidnerf_core.orientation import UPRIGHT


@dataclass(frozen=True)
class GivenCamera:
    """At most one of intrinsics or a file that holds them, a focal length (pixels), and a horizontal field of view (degrees)."""

    camera: Intrinsics | str | Path | None = None
    focal: float | None = None
    hfov: float | None = None

    @property
    def is_given(self) -> bool:
        return any(given is not None for given in (self.camera, self.focal, self.hfov))

    def require(self, path: Path, why: str) -> None:
        """Raise ``InputError`` where no camera is given; ``why`` says why one is needed."""
        if not self.is_given:
            raise InputError(f"{path}: {why}, expected a camera: {WAYS}")

    def of(self, path: Path, width: int, height: int) -> CameraSource:
        """Return the camera of an upright image. Raises ``InputError`` as ``find_camera`` does."""
        return find_camera(
            str(path), Raster(width, height, UPRIGHT), Exif(), self.camera, self.focal, self.hfov
        )
