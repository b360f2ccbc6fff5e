"""Image files, each with a camera, a pose and possibly depth: the common form of many formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from bidnerf_core.camera import CameraSource
from bidnerf_core.datasets.incomplete import present, remark
from bidnerf_core.datasets.rgbd import DepthFile, read_rgbd
from bidnerf_core.datasets.splits import SplitDataset
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import is_file


@dataclass(frozen=True, eq=False)
class ImageFrame:
    """An image file and its metadata from a format."""

    image: Path
    camera: CameraSource
    T_world_camera: SE3 | None
    time: float | None = None  # seconds
    depth: DepthFile | None = None

    @property
    def stem(self) -> str:
        return self.image.name.partition(".")[0] if self.image.stem.endswith(".color") else self.image.stem

    @property
    def parts(self) -> tuple[str, ...]:
        return (*self.image.parts[:-1], self.stem)


class ImageDataset(SplitDataset[ImageFrame]):
    """Views of image files; see ``Dataset``."""

    def _frame(self, frame: ImageFrame, name: str) -> Frame:
        return read_rgbd(name, frame.image, frame.camera.at(frame.image), self._background, frame.depth)

    def _pose(self, frame: ImageFrame) -> SE3 | None:
        return frame.T_world_camera


class MetricImageDataset(ImageDataset):
    """Views of image files of a format whose poses are in metres."""

    unit: LengthUnit | None = "metres"


def images_there(where: Path, frames: Sequence[ImageFrame]) -> list[ImageFrame]:
    """Return the frames whose image exists; a remark about ``where``, the list that names them, counts the others."""
    return present(
        frames,
        lambda frame: is_file(frame.image),
        where,
        lambda frame: frame.image.name,
        lambda frame: InputError(f"no such file, although {where} lists it", where=frame.image),
    )


def images_posed(where: Path, frames: Sequence[ImageFrame]) -> list[ImageFrame]:
    """Return the frames with a pose; a remark about ``where`` counts the others. Raises ``InputError`` if
    none has one.
    """
    posed = [frame for frame in frames if frame.T_world_camera is not None]
    if not posed:
        raise InputError(
            f"has no pose for any of {amount(len(frames), 'image')}", where=where, expected="at least one"
        )
    if len(posed) < len(frames):
        remark(
            where,
            f"{len(frames) - len(posed)} of {amount(len(frames), 'image')} have no pose and are left out",
        )
    return posed
