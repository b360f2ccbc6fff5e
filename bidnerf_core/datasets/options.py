"""Options for reading images. This module imports neither torch nor the readers, so that help pages load fast."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias, Union

from bidnerf_core.errors import InputError, UsageError
from bidnerf_core.io import require_existing
from bidnerf_core.settings import EXPERT, FARTHEST, WholeNumbers

if TYPE_CHECKING:
    from bidnerf_core.camera import Camera, CameraSource
    from bidnerf_core.datasets.capture import Capture
    from bidnerf_core.datasets.reader import Reader
    from bidnerf_core.depth import DepthCamera
    from bidnerf_core.frames import MaskFolder
    from bidnerf_core.io import Background

DepthRegistration: TypeAlias = Union[bool, "DepthCamera", str, Path]
"""How depth is registered to colour images: from a given sensor or its file, from the format's own sensor
(True), or not at all (False)."""


@dataclass(frozen=True)
class DatasetOptions:
    """Options for reading images, shared by the commands, the Python API, the service and the format readers.

    ``camera``, ``register_depth`` and ``depth_unit`` are passed only to readers that accept them. The command line has an option
    for each field, named by the field's annotation and described by the text below the field.
    """

    camera: Annotated[Camera | CameraSource | str | Path | None, "CAMERA.json"] = None
    """camera of images whose format stores none: a file with intrinsics, as JSON of nerfstudio, Open3D, RealSense, 3D Gaussian
    Splatting or an answer, COLMAP's cameras.txt, a list of hloc, YAML of ROS, OpenCV, ORB-SLAM or Kalibr, ROS's ost.txt, XML of
    OpenCV or Agisoft, or a 3x3 matrix as text (TUM RGB-D: also freiburg1, freiburg2 or freiburg3)"""

    images: Annotated[str | Path | None, EXPERT, "DIR"] = None
    """folder of the images that the files of a dataset list, if they lie elsewhere (default: as the format says)"""

    split: Annotated[str, "NAME"] = "train"
    """split of the dataset; all: every image with a pose"""

    register_depth: Annotated[DepthRegistration | None, EXPERT, "SENSOR.json"] = None
    """file with the intrinsics of the depth camera and T_colour_depth (4x4), from which depth is registered to colour images;
    'no' if depth is already registered (default: as the format says)"""

    depth_unit: Annotated[float | None, EXPERT, "METRES"] = None
    """metres per step of the depth images, such as 0.001 for millimetres (default: as the format says)"""

    masks: Annotated[str | Path | MaskFolder | None, "DIR"] = None
    """folder of masks named like the images; black pixels are ignored, for example people"""

    mask_hides: Annotated[Literal["black", "white"], EXPERT, "COLOUR"] = "black"
    """colour in --masks that is ignored: black or white"""

    largest: Annotated[int | None, WholeNumbers(1), EXPERT, "PX"] = None
    """longer side to which larger images are downscaled (default: 1600, or less if memory is short or the format says so)"""

    background: Annotated[Background | None, EXPERT, "COLOUR"] = None
    """colour behind images with alpha: white or black (default: white for transforms.json with alpha, else black)"""

    def __post_init__(self) -> None:
        if self.masks is None and self.mask_hides != "black":
            raise UsageError(
                f"`mask_hides` {self.mask_hides} was given without `masks`", expected="the folder of masks"
            )
        if self.depth_unit is not None and not 0 < self.depth_unit <= FARTHEST:
            raise InputError(
                f"depth_unit is {self.depth_unit:g}", expected="a positive number of metres per step, such as 0.001"
            )

    def open(self, path: str | Path, readers: Sequence[Reader] | None = None) -> Capture:
        """Open the dataset in the folder ``path``.

        Metadata is read and checked immediately, images only when views are requested. Files that are listed but
        missing, and images without a pose, are left out with an ``InputWarning`` that counts them. Raises
        ``InputError`` if the folder does not exist, if no reader recognizes it, if no image is left, and if a
        metadata file is invalid.
        """
        from bidnerf_core.datasets.reader import read_capture

        return read_capture(self, path, readers)

    def open_sequence(self, path: str | Path, readers: Sequence[Reader] | None = None) -> Capture:
        """Open the frames of a dataset, a folder of images or a video in chronological order; nothing is decoded yet.

        Unless a camera is given, photos take it from EXIF; photos without a focal length, and videos, use one of the
        assumed cameras of a ``CameraSource``. Raises ``InputError`` if nothing is found, if a metadata file is invalid,
        and for a missing or superfluous camera.
        """
        from bidnerf_core.datasets.reader import read_capture

        return read_capture(self, path, readers, in_time_order=True)

    def require_files(self) -> None:
        """Raise ``InputError`` if a file or a folder that the options name does not exist."""
        for file in (self.camera, self.register_depth):
            if isinstance(file, str | Path) and Path(file).suffix:  # others are names, such as freiburg1
                require_existing(file, expected="a file with the intrinsics")
        for folder, expected in ((self.images, "the folder of the images"), (self.masks, "a folder of masks")):
            require_existing(folder if isinstance(folder, str | Path) else None, expected=expected)

    @property
    def camera_source(self) -> CameraSource:
        """The camera options as a ``CameraSource`` for single images."""
        from bidnerf_core.camera import CameraSource

        return self.camera if isinstance(self.camera, CameraSource) else CameraSource(self.camera)

    @property
    def given_camera(self) -> Camera | Path | None:
        """The camera for formats that do not store one: intrinsics or a file with intrinsics."""
        camera = self.camera_source.camera
        return Path(camera) if isinstance(camera, str) else camera

    @property
    def colour(self) -> tuple[float, float, float]:
        """The background colour, by default black. Raises ``InputError`` for an unknown colour."""
        from bidnerf_core.io import background_colour

        return background_colour("black" if self.background is None else self.background)

    @property
    def mask_folder(self) -> MaskFolder | None:
        """The mask folder. Raises ``InputError`` if the folder does not exist or contains no image."""
        from bidnerf_core.frames import MaskFolder

        if self.masks is None or isinstance(self.masks, MaskFolder):
            return self.masks
        return MaskFolder(self.masks, self.mask_hides)

    @property
    def image_folder(self) -> Path | None:
        """The folder of the images, if it is given. Raises ``InputError`` unless it is a folder."""
        if self.images is None or (folder := Path(self.images)).is_dir():
            return None if self.images is None else folder
        raise InputError("is a file", where=folder, expected="the folder of the images")

    @property
    def registration(self) -> DepthRegistration | None:
        """The value of ``register_depth``, with False instead of ``"no"``."""
        return False if self.register_depth == "no" else self.register_depth

    def sensor(self, where: Path | str, own: DepthCamera | None = None) -> DepthCamera | None:
        """Return the sensor from which depth is registered, or None for no registration; ``own`` is the format's sensor.

        Raises ``InputError``, whose message begins with ``where``, if ``register_depth`` is True but the format has no
        sensor, and as ``DepthCamera.read`` does.
        """
        from bidnerf_core.depth import DepthCamera

        register = self.registration
        if register is None or register is True:
            if register and own is None:
                raise InputError(
                    "its depth sensor is not known", where=where, expected="the file of one (`register_depth`)"
                )
            return own
        if register is False:
            return None
        return register if isinstance(register, DepthCamera) else DepthCamera.read(Path(register))


TEST_IMAGES = DatasetOptions(split="test")
"""The default options for images with which a map is tested."""
AS_STORED = DatasetOptions()
"""The options for images of split "train" as the dataset stores them."""
