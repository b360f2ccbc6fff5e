"""Scenes of Cambridge Landmarks (PoseNet), models of VisualSFM, and scenes of Map-free relocalization: lists of images with poses.

``dataset_train.txt`` and ``dataset_test.txt`` have rows of an image's name, the camera's position, and the quaternion (w x y
z) from world to camera (OpenCV axes, metres). Focal lengths and radial distortion are those of the model of VisualSFM beside
them, ``reconstruction.nvm``; without it, the camera is the given one or that of EXIF. Without lists, a model (``NVM_V3``: name,
focal length, quaternion from world to camera, position, radial distortion r) is read by itself, in its own unit. Its lens is
d (1 + r d²) = u for distorted and undistorted radii d and u in focal lengths, whose inverse is u - r u³ + 3 r² u⁵ - 12 r³ u⁷.

Map-free: ``poses.txt`` has rows of a name, the quaternion (w x y z) and the translation from world to camera (metres), and
``intrinsics.txt`` rows of the same name, fx, fy, cx, cy, width and height.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

from bidnerf.formats.reality_capture import file_heads
from bidnerf_core.camera import CameraSource, Intrinsics
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    FileNames,
    Format,
    Shot,
    camera_of,
    first_file,
    pose_of_numbers,
    posix_name,
)
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Row, is_file, read_header, read_rows

LISTS = {"train": "dataset_train.txt", "test": "dataset_test.txt"}
Listed: TypeAlias = tuple[Row, list[float]]
"""The row of an image, and the numbers after its name."""


def _read(path: Path, file: Path, options: DatasetOptions) -> Capture:
    """Read the lists. Raises ``InputError`` if one is invalid."""
    model, images = next(iter(sorted(path.glob("*.nvm"))), None), dict[str, tuple[str, Row, list[float]]]()
    rows = {} if model is None else _rows(model, 10)
    lists = {split: _rows(path / name, 7) for split, name in LISTS.items() if is_file(path / name)}
    map_free = file.name == "poses.txt"
    if map_free:  # of which lists have the quaternion first
        rows, lists[""] = _rows(path / "intrinsics.txt", 6), _rows(file, 7)
    for split, listed in (lists or {"": rows}).items():
        for name, (row, n) in listed.items():
            images[name] = split, row, [*n[-3:], *n[:-3]] if map_free else n if lists else [*n[5:8], *n[1:5]]
    if not images:
        raise InputError("lists no images", where=file, expected="rows of a name and a pose")
    lenses = {posix_name(name).with_suffix(""): listed for name, listed in rows.items()}

    def read(image: Path, name: str, entry: tuple[str, Row, list[float]]) -> Shot:
        split, row, (x, y, z, qw, *q) = entry
        T = pose_of_numbers(row.where, [x, y, z, *q, qw], opengl=False)
        if T is None:
            raise row.error(": is no pose")
        # Lists have the position beside the rotation to the camera, those of Map-free the translation.
        pose, camera = T.inverse() if map_free else SE3(T.rotation.mT, T.translation), options.camera_source
        if (lens := lenses.get(posix_name(name).with_suffix(""))) and not camera.is_given:
            camera = CameraSource(_camera(*lens, image))
        return Shot(image=image, camera=camera, T_world_camera=pose, splits=(split,) if split else ())

    names, unit = FileNames(path, path / "images", images=options.image_folder), file.suffix != ".nvm"
    return Capture(path, names.shots(images, read), options.colour, "metres" if unit else None, pose_file=file)


def _find(path: Path) -> Path | None:
    """Return the first list of images, the model, or the poses of a scene whose intrinsics are listed by image too."""
    heads = file_heads(path, "intrinsics.txt", "a list of cameras")
    rows = (head.partition(b"\n")[0].split() for _, head in heads)
    by_image = ["poses.txt" for words in rows if len(words) == 7 and b"." in words[0]]
    return first_file(path, *by_image, *LISTS.values()) or next(iter(sorted(path.glob("*.nvm"))), None)


def _rows(file: Path, count: int) -> dict[str, Listed]:
    """Return the rows of a name and ``count`` numbers by name, each with its numbers; a heading is left out."""
    rows = read_rows(file, "a list of images", f"a name and {count} numbers")
    if file.suffix == ".nvm":
        most = next((int(row.text) for row in rows[1:2] if row.text.isdecimal() and len(row.text) < 9), 0)
        rows = rows[2 : 2 + most]
    elif rows and rows[0].text.startswith("Visual Landmark Dataset"):
        rows = rows[2:]
    found = dict[str, Listed]()
    for row in rows:
        name, *words = row.text.rsplit(maxsplit=count)
        found[name] = row, row.numbers(words, count)
    return found


def _camera(row: Row, numbers: list[float], image: Path) -> Intrinsics:
    if len(numbers) == 6:
        return camera_of(row.where, numbers[:4], (round(numbers[4]), round(numbers[5])), first_centre=0)
    size, focal, r = read_header(image).size, numbers[0], numbers[8]
    lens = (-r, 3 * r * r, 0.0, 0.0, -12 * r**3)
    return camera_of(row.where, (focal, focal, size[0] / 2, size[1] / 2), size, lens, first_centre=0)


reader = Format(
    "Cambridge Landmarks, models of VisualSFM (.nvm) and scenes of Map-free relocalization, without depth",
    "dataset_train.txt with reconstruction.nvm (Cambridge Landmarks), or a .nvm, or poses.txt with intrinsics.txt (Map-free)",
    _find,
    _read,
    ["camera", "focal", "images"],
    precedence=25,  # lists made from a model, so preferred to it
)
