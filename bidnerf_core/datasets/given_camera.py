"""User-given cameras of images that come without a description."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

from bidnerf_core.camera.exif import Exif
from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.orientation import UPRIGHT
from bidnerf_core.camera.source import WAYS, CameraSource, Raster, find_camera
from bidnerf_core.datasets.depth_registration import DepthCamera
from bidnerf_core.depth.images import read_depth_image
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.frames.frame import Frame
from bidnerf_core.io.images import Background


@dataclass(frozen=True)
class GivenCamera:
    """At most one of intrinsics or a file that holds them, a focal length (pixels), and a horizontal field of view (degrees).

    Depth is registered to the images from ``sensor``, if there is one. ``assumed`` are cameras of which one probably took the
    images whose focal length is unknown.
    """

    camera: Intrinsics | str | Path | None = None
    focal: float | None = None
    hfov: float | None = None
    sensor: DepthCamera | None = None
    assumed: tuple[Intrinsics, ...] = ()

    @property
    def is_given(self) -> bool:
        return any(given is not None for given in (self.camera, self.focal, self.hfov))

    def require(self, path: Path, why: str) -> None:
        """Raise ``InputError`` where no camera is given or assumed; ``why`` is the reason why one is needed."""
        if not self.is_given and not self.assumed:
            raise InputError(f"{path}: {why}, expected a camera: {WAYS}")

    def of(self, path: Path, width: int, height: int) -> CameraSource:
        """Return the camera of an upright image. Raises ``InputError`` as ``find_camera`` does."""
        return find_camera(
            str(path),
            Raster(width, height, UPRIGHT),
            Exif(),
            self.camera,
            self.focal,
            self.hfov,
            self.assumed,
        )

    def read(
        self, image: Path, depth: Path | None, depth_unit: float | None, background: Background
    ) -> Frame:
        """Read an image and its depth, upright. Without a camera, that of EXIF is used, or else an assumed one.

        Raises ``InputError`` as ``Frame.open`` does.
        """
        apart = self.sensor is not None and depth is not None
        frame = Frame.open(
            image, depth=None if apart else depth, depth_unit=depth_unit, camera=self.camera, focal=self.focal,
            hfov=self.hfov, assumed=self.assumed, background=background,
        )  # fmt: skip
        if self.sensor is None or depth is None:
            return frame
        measured = read_depth_image(depth, depth_unit)
        remark = measured.remark(depth_unit is None)
        if remark is not None:
            warnings.warn(f"{depth}: {remark}", InputWarning, stacklevel=2)
        return replace(frame, depth=self.sensor.registered(measured.metres, frame.intrinsics, depth))
