"""Photos whose cameras were exported by RealityCapture as comma-separated values ("Internal/External camera
parameters").

The columns are ``#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2``. The rotation of the camera
(OpenGL axes) is ``Rz(-heading) Rx(pitch) Ry(roll)``, in degrees, in a world whose z points up. ``f`` is the
focal length in millimetres for a film 36 mm wide, ``px`` and ``py`` are the offset of the principal point
from the image centre, both relative to the longer side of the photo; ``k1`` to ``t2`` are Brown's distortion
in OpenCV's convention. Photos are in the folder, or in ``images``. Every eighth photo in natural name order
(the first, the ninth ...) is held out as "test" and the others are "train".
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.camera import CameraSource, Intrinsics
from bidnerf_core.datasets.dataset import Dataset
from bidnerf_core.datasets.file_names import IMAGE_ENDINGS, FileNames, posix_name
from bidnerf_core.datasets.incomplete import present
from bidnerf_core.datasets.posed_images import ImageDataset, ImageFrame
from bidnerf_core.datasets.reader import Reader, ReadOptions
from bidnerf_core.datasets.sequence import FrameSequence
from bidnerf_core.datasets.splits import Splits, hold_out
from bidnerf_core.errors import InputError
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Row, open_binary, read_header, read_lines

POSE = ("x", "y", "alt", "heading", "pitch", "roll")
LENS = ("k1", "k2", "t1", "t2", "k3")
FILM = 36.0
"""Millimetres: the width to which focal lengths refer."""
LONGEST_HEADER = 2000
IMAGES = ("", "images", "input")


@dataclass(frozen=True)
class _Photo:
    """A row of the list, keyed by column name, and its photo if that exists."""

    row: Row
    values: Mapping[str, str]
    image: Path | None

    def number(self, key: str) -> float:
        return self.row.numbers([self.values.get(key) or "0"])[0]


class RealityCaptureReader(Reader):
    """Reader for RealityCapture's camera lists."""

    expected = "photos with a .csv of #name,x,y,alt,heading,pitch,roll,f (RealityCapture)"

    def recognises(self, path: Path) -> bool:
        return _list(path) is not None

    def open(self, path: Path, options: ReadOptions) -> Dataset:
        """Read the list. Raises ``InputError`` if a row is invalid, and if no photo exists."""
        return self._open(path, options)

    def open_sequence(self, path: Path, options: ReadOptions) -> FrameSequence:
        return self._open(path, options).sequence()

    def _open(self, path: Path, options: ReadOptions) -> ImageDataset:
        file = _list(path)
        assert file is not None  # ensured by recognises
        frames = [_frame(photo) for photo in _photos(path, file)]
        frames.sort(key=lambda frame: natural_order(frame.image.name))
        return ImageDataset(Splits(path, hold_out(frames)), options.background)


def _list(path: Path) -> Path | None:
    for file in sorted(path.glob("*.csv")):
        try:
            with open_binary(file, "a list of cameras") as opened:
                names = _columns(opened.readline(LONGEST_HEADER).decode("utf-8-sig", "replace"))
        except InputError:
            continue
        if names[:1] == ["name"] and set(POSE) <= set(names):
            return file
    return None


def _columns(line: str) -> list[str]:
    return [name.strip().lstrip("#").strip().lower() for name in line.split(",")]


def _photos(path: Path, file: Path) -> list[_Photo]:
    first, *rows = read_lines(file, "a list of cameras", "the columns of RealityCapture's export")
    names, found = _columns(first.text), list[_Photo]()
    if "f" not in names:
        raise InputError(
            "has no column f",
            where=file,
            expected="the export 'Internal/External camera parameters', which has focal lengths",
        )
    places = [FileNames(path / place) for place in IMAGES if (path / place).is_dir()]
    for row in rows:
        if not row.text:
            continue
        try:
            (words,) = csv.reader([row.text])
        except csv.Error as error:  # such as a carriage return inside a field
            raise row.error(f" is no row of comma-separated values ({error})") from error
        if len(words) < len(names):
            raise row.error(f" has {len(words)} of {len(names)} entries")
        values = dict(zip(names, words, strict=False))
        name = posix_name(values["name"])
        images = (place.find(name, IMAGE_ENDINGS) for place in places)
        found.append(_Photo(row, values, next((image for image in images if image is not None), None)))
    if not found:
        raise InputError("has no rows", where=file, expected="one for each photo")
    return present(
        found,
        lambda photo: photo.image is not None,
        file,
        lambda photo: photo.values["name"],
        lambda photo: InputError(
            f"no photo {photo.values['name']} in {path}",
            where=photo.row.where,
            expected="it there or in images",
        ),
        noun="photo",
    )


def _frame(photo: _Photo) -> ImageFrame:
    assert photo.image is not None  # ensured by present
    heading, pitch, roll = (photo.number(key) for key in ("heading", "pitch", "roll"))
    turn = Rotation.from_euler("ZXY", [-heading, pitch, roll], degrees=True).as_matrix()
    rotation = torch.from_numpy(turn) * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    place = torch.tensor([photo.number(key) for key in POSE[:3]], dtype=torch.float64)
    return ImageFrame(photo.image, CameraSource(_camera(photo, photo.image)), SE3(rotation, place))


def _camera(photo: _Photo, image: Path) -> Intrinsics:
    header = read_header(image)
    longer = max(header.width, header.height)
    if photo.number("k4") != 0:
        raise photo.row.error(
            ": k4 is not 0, which OpenCV's model does not support; export undistorted images instead"
        )
    lens = tuple(photo.number(key) for key in LENS)
    focal = photo.number("f") * longer / FILM
    centre = (header.width / 2 + photo.number("px") * longer, header.height / 2 + photo.number("py") * longer)
    try:
        return Intrinsics(
            focal,
            focal,
            *centre,
            header.width,
            header.height,
            (lens if lens[4] else lens[:4]) if any(lens) else (),
        )
    except InputError as error:
        raise InputError(error, where=photo.row.where) from error


reader = RealityCaptureReader()
