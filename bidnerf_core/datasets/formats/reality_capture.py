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
from collections.abc import Callable
from pathlib import Path

import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets.capture import Capture, Shot, present
from bidnerf_core.datasets.file_names import IMAGE_ENDINGS, FileNames, posix_name
from bidnerf_core.datasets.reader import DatasetOptions, Reader
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


class RealityCaptureReader(Reader):
    """Reader for RealityCapture's camera lists."""

    expected = "photos with a .csv of #name,x,y,alt,heading,pitch,roll,f (RealityCapture)"

    def recognises(self, path: Path) -> bool:
        return _list(path) is not None

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the list. Raises ``InputError`` if a row is invalid, and if no photo exists."""
        file = _list(path)
        assert file is not None  # ensured by recognises
        first, *rows = read_lines(file, "a list of cameras", "the columns of RealityCapture's export")
        names = _columns(first.text)
        if "f" not in names:
            expected = "the export 'Internal/External camera parameters', which has focal lengths"
            raise InputError("has no column f", where=file, expected=expected)
        values = [(row, dict(zip(names, _words(row, len(names)), strict=False))) for row in rows if row.text]
        if not values:
            raise InputError("has no rows", where=file, expected="one for each photo")
        places = [FileNames(path / place) for place in IMAGES if (path / place).is_dir()]
        found = [
            (
                row,
                value,
                next(
                    (
                        image
                        for place in places
                        if (image := place.find(posix_name(value["name"]), IMAGE_ENDINGS))
                    ),
                    None,
                ),
            )
            for row, value in values
        ]
        there = present(
            found,
            lambda photo: photo[2] is not None,
            file,
            lambda photo: photo[1]["name"],
            lambda photo: InputError(
                f"no photo {photo[1]['name']} in {path}",
                where=photo[0].where,
                expected="it there or in images",
            ),
            noun="photo",
        )
        shots = [_shot(row, value, image) for row, value, image in there if image is not None]
        shots.sort(key=lambda shot: natural_order("" if shot.file is None else shot.file.name))
        return Capture(path, shots, options.colour, pose_file=file)


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


def _words(row: Row, count: int) -> list[str]:
    try:
        (words,) = csv.reader([row.text])
    except csv.Error as error:  # such as a carriage return inside a field
        raise row.error(f" is no row of comma-separated values ({error})") from error
    if len(words) < count:
        raise row.error(f" has {len(words)} of {count} entries")
    return words


def _shot(row: Row, values: dict[str, str], image: Path) -> Shot:
    def number(key: str) -> float:
        return row.numbers([values.get(key) or "0"])[0]

    angles = [-number("heading"), number("pitch"), number("roll")]
    turn = torch.from_numpy(Rotation.from_euler("ZXY", angles, degrees=True).as_matrix())
    position = torch.tensor([number(key) for key in POSE[:3]], dtype=torch.float64)
    pose = SE3(turn * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64), position)
    return Shot(image=image, camera=_camera(row, number, image), T_world_camera=pose)


def _camera(row: Row, number: Callable[[str], float], image: Path) -> Intrinsics:
    header = read_header(image)
    longer = max(header.width, header.height)
    if number("k4") != 0:
        raise row.error(
            ": k4 is not 0, which OpenCV's model does not support; export undistorted images instead"
        )
    lens = tuple(number(key) for key in LENS)
    lens = (lens if lens[4] else lens[:4]) if any(lens) else ()
    focal = number("f") * longer / FILM
    centre = header.width / 2 + number("px") * longer, header.height / 2 + number("py") * longer
    try:
        return Intrinsics(focal, focal, *centre, header.width, header.height, lens)
    except InputError as error:
        raise InputError(error, where=row.where) from error


reader = RealityCaptureReader()
