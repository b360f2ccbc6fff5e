"""The files of a COLMAP sparse model: ``cameras``, ``images`` and ``points3D``, as .bin or .txt.

Formats: https://colmap.github.io/format.html. Poses are ``cam_from_world`` with OpenCV's camera axes. The
files ``rigs`` and ``frames`` of newer versions are not needed, since these versions still write each image's
pose to ``images``. pycolmap is not used because it hangs on a truncated ``points3D.bin``.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.camera import MODEL_IDS, MODELS, Camera, colmap_camera, read_text_cameras
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Row, read_file, read_lines

_Item = TypeVar("_Item")

NAMES = ("images", "points3D")
COUNT, IMAGE, POINT = struct.Struct("<Q"), struct.Struct("<I7dI"), struct.Struct("<q3d3BdQ")
OBSERVATION = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
CAMERA_RECORD = struct.Struct("<IiQQ")
MODEL_FILE = "a file of a COLMAP sparse model"
LARGEST_MODEL = 2**30  # bytes of one file of a model
TRACK_BYTES = 8  # an image and one of its keypoints, 4 bytes each


@dataclass(frozen=True, eq=False)
class ModelImage:
    """A registered image of the model."""

    name: str  # path below the folder of images
    camera: int  # id of its camera
    T_camera_model: SE3  # in units of the model
    points: Int[Tensor, "n"]  # ids of the observed points


@dataclass(frozen=True)
class ModelPoint:
    """A triangulated point of the model."""

    id: int
    position: tuple[float, float, float]  # model frame, in units of the model
    error: float  # mean reprojection error, pixels; negative where it was never computed
    track: int  # number of observations


@dataclass(frozen=True, eq=False)
class ModelPoints:
    """All points of a model, in the order of their ids."""

    ids: Int[Tensor, "p"]
    positions: Float[Tensor, "p 3"]  # model frame, in units of the model
    errors: Float[Tensor, "p"]  # see ModelPoint
    tracks: Int[Tensor, "p"]


def read_model(folder: Path) -> tuple[list[ModelImage], ModelPoints]:
    """Read the model in ``folder``. Raises ``InputError`` if there is none, or if a file is damaged."""
    suffix = next((s for s in (".bin", ".txt") if _is_model(folder, s)), None)
    if suffix is None:
        inside = [
            child for child in (folder / "sparse/0", folder / "sparse", folder / "0") if _any_model(child)
        ]
        hint = f"; did you mean {inside[0]}?" if inside else ""
        wanted = "images.bin and points3D.bin, or the same as .txt"
        raise InputError("no COLMAP sparse model in it", where=folder, expected=f"{wanted}{hint}")
    images, points = (folder / f"{name}{suffix}" for name in NAMES)
    if suffix == ".bin":
        return _binary(images, _binary_image), _together(points, _binary(points, _binary_point))
    return _text_images(images), _together(points, _text_points(points))


def read_posed_images(folder: Path) -> tuple[list[ModelImage], dict[int, Camera]]:
    """Read the images of the model in ``folder``, and their cameras by id; its points may be missing.

    Raises ``InputError`` if there is no model, if a file is damaged, and for a camera that is not
    perspective.
    """
    suffix = next((s for s in (".bin", ".txt") if has_posed_images(folder, s)), None)
    if suffix is None:
        raise InputError(
            "no cameras and images of a COLMAP sparse model", where=folder, expected=".bin or .txt"
        )
    cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
    if suffix == ".txt":
        return _text_images(images), read_text_cameras(cameras)
    return _binary(images, _binary_image), dict(_binary(cameras, _binary_camera))


def count_posed_images(folder: Path) -> int:
    """Return the number of images that the model in ``folder`` declares. Raises ``InputError`` as
    ``read_posed_images`` does.
    """
    if has_posed_images(folder, ".bin"):
        (count,) = _Bytes(folder / "images.bin").take(COUNT)
        return int(count)
    return len(_text_images(folder / "images.txt"))


def has_posed_images(folder: Path, suffix: str | None = None) -> bool:
    """Return whether a folder has a model's cameras and images, as .bin or .txt unless ``suffix`` restricts it."""
    suffixes = (".bin", ".txt") if suffix is None else (suffix,)
    return any(
        all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images")) for suffix in suffixes
    )


def _binary_camera(file: _Bytes) -> tuple[int, Camera]:
    number, model, width, height = file.take(CAMERA_RECORD)
    name = MODEL_IDS.get(model)
    if name is None:
        expected = ", ".join(MODEL_IDS.values())
        raise InputError(
            f"camera {number} has the model {model}",
            where=file.path,
            expected=f"one of {expected}; undistort the images with COLMAP",
        )
    parameters = file.array(np.dtype("<f8"), max(MODELS[name][2]) + 1).tolist()
    return int(number), colmap_camera(
        f"{file.path}: camera {number}", name, int(width), int(height), parameters
    )


def _is_model(folder: Path, suffix: str) -> bool:
    return all((folder / f"{name}{suffix}").is_file() for name in NAMES)


def _any_model(folder: Path) -> bool:
    return _is_model(folder, ".bin") or _is_model(folder, ".txt")


class _Bytes:
    """A binary file that is parsed from its beginning to its end."""

    def __init__(self, path: Path) -> None:
        self.path, self._content, self._place = path, _content(path), 0

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        start = self._advance(layout.size)
        return layout.unpack_from(self._content, start)

    def array(self, kind: np.dtype, count: int) -> np.ndarray:
        start = self._advance(kind.itemsize * count)
        return np.frombuffer(self._content, kind, count, start)

    def text(self) -> str:
        end = self._content.find(b"\0", self._place)
        start = self._advance((len(self._content) if end < 0 else end + 1) - self._place)
        return self._content[start : self._place - 1].decode("utf-8", "replace")

    def skip(self, size: int) -> None:
        self._advance(size)

    @property
    def left(self) -> int:
        return len(self._content) - self._place

    def _advance(self, size: int) -> int:
        if size > self.left:
            length = len(self._content)
            raise InputError(
                f"ends too early, at byte {length};", where=self.path, expected="a complete COLMAP file"
            )
        self._place += size
        return self._place - size


def _binary(path: Path, one: Callable[[_Bytes], _Item]) -> list[_Item]:
    """Read a count, then that many items, each with ``one``."""
    file = _Bytes(path)
    (count,) = file.take(COUNT)
    if count > file.left:  # a false count must not allocate memory
        raise InputError(f"declares {count} entries in {file.left} bytes; is the file damaged?", where=path)
    found = [one(file) for _ in range(int(count))]
    if file.left:
        raise InputError(f"{file.left} bytes after its {count} entries", where=path, expected="a COLMAP file")
    return found


def _binary_image(file: _Bytes) -> ModelImage:
    _, *pose, camera = file.take(IMAGE)
    name = file.text()
    (count,) = file.take(COUNT)
    observed = file.array(OBSERVATION, int(count))["point"]
    return _image(str(file.path), name, int(camera), pose, observed[observed >= 0])


def _binary_point(file: _Bytes) -> ModelPoint:
    number, x, y, z, *_, error, track = file.take(POINT)
    file.skip(TRACK_BYTES * int(track))
    return ModelPoint(int(number), (x, y, z), error, int(track))


def _text_images(path: Path) -> list[ModelImage]:
    """Read two lines per image; the second is empty if nothing was observed."""
    found, rows = [], iter(_rows(path, "id, pose, camera and name of an image"))
    for row in rows:
        if not row.text or row.text.startswith("#"):
            continue
        words = row.text.split(maxsplit=9)  # a name may contain spaces
        if len(words) < 10:
            raise row.error(f" has {len(words)} entries")
        following = replace(next(rows, replace(row, text="")), columns="x, y, id of points")
        observed = following.words
        if len(observed) % 3:
            raise following.error(f" has {len(observed)} entries")
        points = np.array([following.integer(word) for word in observed[2::3]], dtype=np.int64)
        pose = row.numbers(words[1:8])
        found.append(_image(row.where, words[9], row.integer(words[8]), pose, points[points >= 0]))
    return found


def _text_points(path: Path) -> list[ModelPoint]:
    found = []
    for row in _rows(path, "id, x y z, r g b, error and a track"):
        if not row.text or row.text.startswith("#"):
            continue
        words = row.words
        if len(words) < 8 or len(words) % 2:
            raise row.error(f" has {len(words)} entries")
        x, y, z, error = row.numbers([*words[1:4], words[7]])
        found.append(ModelPoint(row.integer(words[0]), (x, y, z), error, (len(words) - 8) // 2))
    return found


def _image(where: str, name: str, camera: int, pose: Sequence[float], points: np.ndarray) -> ModelImage:
    """Build an image from a ``pose``, which is a quaternion w x y z followed by a translation."""
    if not (np.isfinite(pose).all() and 0.5 < np.linalg.norm(pose[:4]) < 2):
        raise InputError(f"image {name!r} has an invalid pose", where=where, expected="a unit quaternion")
    rotation = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
    T = SE3(torch.from_numpy(rotation), torch.tensor(pose[4:], dtype=torch.float64))
    return ModelImage(name, camera, T, torch.from_numpy(np.unique(points)))


def _together(path: Path, points: list[ModelPoint]) -> ModelPoints:
    ordered = sorted(points, key=lambda point: point.id)
    ids = torch.tensor([point.id for point in ordered], dtype=torch.int64)
    if bool((ids.diff() == 0).any()):
        raise InputError("two points have the same id", where=path, expected="unique ids")
    positions = torch.tensor([point.position for point in ordered], dtype=torch.float64).reshape(-1, 3)
    errors = torch.tensor([point.error for point in ordered], dtype=torch.float64)
    tracks = torch.tensor([point.track for point in ordered], dtype=torch.int64)
    return ModelPoints(ids, positions, errors, tracks)


def _rows(path: Path, columns: str) -> list[Row]:
    return read_lines(path, MODEL_FILE, columns, LARGEST_MODEL)


def _content(path: Path) -> bytes:
    return read_file(path, MODEL_FILE, LARGEST_MODEL)
