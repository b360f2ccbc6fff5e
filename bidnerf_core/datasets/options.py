"""The options with which a dataset, a folder of images or a video is read: one set for commands, Python and the service."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.camera import Camera, CameraSource
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.open import open_dataset, open_sequence
from bidnerf_core.datasets.reader import DepthRegistration
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.depth import DepthCamera
from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.frames import HiddenColour, MaskFolder
from bidnerf_core.io import Background

UNREGISTERED = "no"
"""The value of ``register_depth`` with which depth is used as it is, besides False."""


@dataclass(frozen=True)
class DatasetOptions:
    """How images are read. ``open`` and ``open_sequence`` read them, and readers of a format receive the same options."""

    camera: Camera | CameraSource | str | Path | None = None
    """camera of images whose format stores none: a file with intrinsics from nerfstudio, COLMAP, ROS or OpenCV (YAML), Open3D,
    hloc or 3D Gaussian Splatting (TUM RGB-D: also freiburg1, freiburg2 or freiburg3)"""

    split: str = "train"
    """split of the dataset; all: every image with a pose"""

    register_depth: DepthRegistration | None = None
    """file with the intrinsics of the depth camera and T_colour_depth (4x4), from which depth is registered to colour images;
    'no' if depth is already registered"""

    depth_unit: float | None = None
    """metres per step of the depth images, such as 0.001 for millimetres"""

    masks: str | Path | MaskFolder | None = None
    """masks named like the images: black pixels (--mask-hides) are ignored, such as people or the robot itself"""

    mask_hides: HiddenColour = "black"
    """colour in --masks that is ignored: black or white"""

    largest: int | None = None
    """longer side to which larger images are downscaled"""

    background: Background | None = None
    """colour behind images with alpha: white or black"""

    def __post_init__(self) -> None:
        if self.masks is None and self.mask_hides != "black":
            raise UsageError(
                f"--mask-hides {self.mask_hides} was given without --masks", expected="the folder of masks"
            )

    def open(self, path: str | Path) -> Dataset:
        """Open the dataset in the folder ``path``, whatever its format; see ``open_dataset`` for its errors."""
        source = self.camera_source
        if source.focal is not None or source.hfov is not None:
            raise InputError("is a dataset", where=path, expected="a camera with all intrinsics (camera=)")
        return open_dataset(
            path, self.background, camera=source.camera, register_depth=self.registration,
            depth_unit=self.depth_unit, masks=self.mask_folder,
        )  # fmt: skip

    def open_sequence(self, path: str | Path) -> FrameSequence:
        """Open the frames of a dataset, a folder of images or a video in chronological order; see ``open_sequence`` for errors."""
        source = self.camera_source
        return open_sequence(
            path, camera=source.camera, focal=source.focal, hfov=source.hfov, assumed=source.assumed,
            background=self.background, register_depth=self.registration, depth_unit=self.depth_unit,
            masks=self.mask_folder,
        )  # fmt: skip

    @property
    def camera_source(self) -> CameraSource:
        """The camera as a source of cameras for single images."""
        return self.camera if isinstance(self.camera, CameraSource) else CameraSource(self.camera)

    @property
    def mask_folder(self) -> MaskFolder | None:
        """The folder of masks. Raises ``InputError`` if there is no such folder, or no image in it."""
        if self.masks is None or isinstance(self.masks, MaskFolder):
            return self.masks
        return MaskFolder(self.masks, self.mask_hides)

    @property
    def registration(self) -> DepthRegistration | None:
        """``register_depth`` as ``open_dataset`` takes it: False if depth is used as it is."""
        return False if self.register_depth == UNREGISTERED else self.register_depth

    def sensor(self, where: Path | str, own: DepthCamera | None = None) -> DepthCamera | None:
        """Return the sensor from which depth is registered, or None if depth is used as it is; ``own`` is the format's.

        Raises ``InputError``, whose message begins with ``where``, for True if the format has no sensor, and
        as ``DepthCamera.read`` does.
        """
        register = self.registration
        if register is None:
            return own
        if register is False:
            return None
        if register is True and own is None:
            raise InputError(
                "its depth sensor is not known", where=where, expected="the file of one (register_depth=)"
            )
        if register is True or isinstance(register, DepthCamera):
            return own if register is True else register
        return DepthCamera.read(Path(register))
