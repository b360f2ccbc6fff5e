"""Folders of a COLMAP project: ``images`` and a sparse model, with no other file.

The model is in ``sparse/0``, ``sparse`` or the folder itself, as .bin or .txt (``cameras`` and ``images``; ``points3D`` is not
read). Images are in ``images``, or in the folder itself, under the names in the model. Every eighth registered image in the
natural order of the names (the first, the ninth ...) is held out as "test" and the others are "train", as is usual for
captures.

The world is that of the model, whose unit of length is arbitrary: poses and maps are in it, not in metres. Images are used as
they are stored, as in COLMAP, whose pixel centres are at +0.5 like ours. The camera of an image that was resized after the
reconstruction is scaled. COLMAP records no times: a sequence is in the order of the names.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.source import CameraSource
from bidnerf_core.datasets.colmap_files import ModelImage, has_posed_images, read_posed_images
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.reader import Reader, ReadOptions
from bidnerf_core.datasets.rgbd import read_rgbd
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import SplitDataset, Splits, hold_out
from bidnerf_core.errors import InputError
from bidnerf_core.frames.frame import Frame
from bidnerf_core.frames.photos import natural_order
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.io.files import is_file

MODELS = ("sparse/0", "sparse", ".")
"""Possible places of a model, in order of preference; COLMAP writes the first of several models to ``sparse/0``."""
IMAGES = ("images", ".")


@dataclass(frozen=True, eq=False)
class ColmapFrame:
    """A registered image."""

    name: PurePosixPath  # below the folder of images
    image: Path
    camera: Intrinsics
    T_world_camera: SE3  # in units of the model

    time = None

    @property
    def stem(self) -> str:
        return self.name.stem

    @property
    def parts(self) -> tuple[str, ...]:
        return (*self.name.parts[:-1], self.stem)


class ColmapReader(Reader):
    """The reader of folders of COLMAP projects."""

    expected = "images with a sparse model in sparse/0 (COLMAP)"

    def recognises(self, path: Path) -> bool:
        return _model_of(path) is not None

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the model. Raises ``InputError`` where it is damaged or has no registered image."""
        return self._open(path, options)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        return self._open(path, options).sequence()

    def _open(self, path: Path, options: ReadOptions) -> ColmapDataset:
        model = _model_of(path)
        assert model is not None  # recognises ensures it
        return ColmapDataset(Splits(path, hold_out(_frames(path, model))), options.background)


class ColmapDataset(SplitDataset[ColmapFrame]):
    """Views of a COLMAP project; see ``Dataset``."""

    def _frame(self, frame: ColmapFrame, name: str) -> Frame:
        return read_rgbd(name, frame.image, CameraSource(frame.camera).at(frame.image), self._background)

    def _pose(self, frame: ColmapFrame) -> SE3:
        return frame.T_world_camera


def _model_of(path: Path) -> Path | None:
    return next((path / place for place in MODELS if has_posed_images(path / place)), None)


def _frames(path: Path, model: Path) -> list[ColmapFrame]:
    images, cameras = read_posed_images(model)
    if not images:
        raise InputError(f"{model}: has no registered image, expected a model with one or more")
    folder = next(path / place for place in IMAGES if (path / place).is_dir())
    frames = [_frame(model, folder, image, cameras) for image in images]
    frames.sort(key=lambda frame: natural_order(str(frame.name)))
    for frame, following in pairwise(frames):
        if frame.name == following.name:
            raise InputError(f"{model}: image {frame.name} is registered twice, expected each once")
    return frames


def _frame(model: Path, folder: Path, image: ModelImage, cameras: dict[int, Intrinsics]) -> ColmapFrame:
    if image.camera not in cameras:
        raise InputError(f"{model}: image {image.name!r} has the camera {image.camera}, which cameras lacks")
    name = PurePosixPath(image.name.replace("\\", "/"))
    if not is_file(folder / name):
        raise InputError(f"{folder / name}: no such file, expected it as {model} has that image")
    return ColmapFrame(name, folder / name, cameras[image.camera], image.T_camera_model.inverse())


reader = ColmapReader()
