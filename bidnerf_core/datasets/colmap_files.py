"""The files of a COLMAP sparse model: ``cameras``, ``images`` and ``points3D``, as .bin or .txt; and depth maps.

Formats: https://colmap.github.io/format.html. Poses are ``cam_from_world`` with OpenCV's camera axes. The
files ``rigs`` and ``frames`` of newer versions are not needed, since these versions still write each image's
pose to ``images``. pycolmap is not used because it hangs on a truncated ``points3D.bin``. A depth map is the text
``width&height&channels&``, then 32-bit floats, row by row: planar z of the undistorted image in units of the model, 0
where nothing was reconstructed.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.camera import MODELS, Camera, colmap_camera, read_text_cameras
from bidnerf_core.depth import DepthImage, depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Row, is_file, read_file, read_lines

_Item = TypeVar("_Item")
_Point = tuple[int, tuple[float, float, float], float, int]
"""The id of a point, its position, its error and the number of its observations."""

MODEL_FILE = "a file of a COLMAP sparse model"
LARGEST_MODEL = 2**30  # bytes of one file of a model


@dataclass(frozen=True, eq=False)
class ModelImage:
    """A registered image of the model."""

    name: str  # path below the folder of images
    camera: int  # id of its camera
    T_camera_model: SE3  # in units of the model
    observed: Int[Tensor, "k"]  # id of the point that each keypoint of the image observes; negative for none

    @property
    def points(self) -> Int[Tensor, "n"]:
        """The ids of the observed points, sorted."""
        return self.observed[self.observed >= 0].unique()


@dataclass(frozen=True, eq=False)
class ModelPoints:
    """All triangulated points of a model, in the order of their ids."""

    ids: Int[Tensor, "p"]
    positions: Float[Tensor, "p 3"]  # model frame, in units of the model
    errors: Float[Tensor, "p"]  # mean reprojection error, pixels; negative where it was never computed
    tracks: Int[Tensor, "p"]  # number of observations


def read_model(folder: Path) -> tuple[list[ModelImage], ModelPoints]:
    """Read the model in ``folder``. Raises ``InputError`` if there is none, or if a file is damaged."""
    images, points = files_of(folder, "images", "points3D") or (None, None)
    if images is None or points is None:
        places = (folder / place for place in ("sparse/0", "sparse", "0"))
        inside = next((place for place in places if files_of(place, "images", "points3D")), None)
        hint = "" if inside is None else f"; did you mean {inside}?"
        wanted = "images.bin and points3D.bin, or the same as .txt"
        raise InputError("no COLMAP sparse model in it", where=folder, expected=f"{wanted}{hint}")
    found = _binary(points, _binary_point) if points.suffix == ".bin" else list(_text_points(points))
    found.sort()
    ids, positions, errors, tracks = zip(*found, strict=True) if found else ((), (), (), ())
    if len(set(ids)) < len(ids):
        raise InputError("two points have the same id", where=points, expected="unique ids")
    return _images(images), ModelPoints(
        torch.tensor(ids, dtype=torch.int64),
        torch.tensor(positions, dtype=torch.float64).reshape(-1, 3),
        torch.tensor(errors, dtype=torch.float64),
        torch.tensor(tracks, dtype=torch.int64),
    )


def read_posed_images(folder: Path) -> tuple[list[ModelImage], dict[int, Camera]]:
    """Read the images of the model in ``folder``, and their cameras by id; its points may be missing.

    Raises ``InputError`` if there is no model, if a file is damaged, and for a camera that is not
    perspective.
    """
    files = files_of(folder, "cameras", "images")
    if files is None:
        expected = ".bin or .txt"
        raise InputError("no cameras and images of a COLMAP sparse model", where=folder, expected=expected)
    cameras, images = files
    if cameras.suffix == ".txt":
        return _images(images), read_text_cameras(cameras)
    return _images(images), dict(_binary(cameras, _binary_camera))


def count_posed_images(folder: Path) -> int:
    """Return the number of images that the model in ``folder`` declares.

    Raises ``InputError`` as ``read_posed_images`` does.
    """
    _, images = files_of(folder, "cameras", "images") or (folder, folder / "images.bin")
    return int(_Bytes(images).take("<Q")[0]) if images.suffix == ".bin" else len(_images(images))


def files_of(folder: Path, *names: str) -> list[Path] | None:
    """Return the files of a model with these names, all as .bin or else all as .txt; None if any is missing."""
    found = ([folder / f"{name}{suffix}" for name in names] for suffix in (".bin", ".txt"))
    return next((files for files in found if all(map(is_file, files))), None)


def depth_map_of(model: Path, name: str) -> Path | None:
    """Return the depth map of an image of a model ``WORKSPACE/sparse`` or ``WORKSPACE/sparse/0``, or None."""
    folders = (folder / "stereo/depth_maps" for folder in (model.parent, model.parent.parent))
    kinds = ("geometric", "photometric")  # the more reliable one first
    files = (folder / f"{name}.{kind}.bin" for folder in folders for kind in kinds)
    return next(filter(is_file, files), None)


def _binary_camera(file: _Bytes) -> tuple[int, Camera]:
    number, model, width, height = file.take("<IiQQ")
    name = next((name for name, (found, _, _) in MODELS.items() if found == model), None)
    if name is None:
        expected = ", ".join(MODELS)
        raise InputError(
            f"camera {number} has the model {model}",
            where=file.path,
            expected=f"one of {expected}; undistort the images with COLMAP",
        )
    parameters = file.array(np.dtype("<f8"), max(MODELS[name][2]) + 1).tolist()
    return int(number), colmap_camera(
        f"{file.path}: camera {number}", name, int(width), int(height), parameters
    )


def read_colmap_depth(path: Path) -> DepthImage:
    """Read a depth map, in units of the model. Raises ``InputError`` for a truncated file or one of another kind."""
    content = read_file(path, "a COLMAP depth map")
    *sizes, numbers = content.split(b"&", 3)
    if len(sizes) != 3 or not all(size.isdigit() and len(size) < 10 for size in sizes):
        raise InputError(
            "does not begin with width&height&channels&", where=path, expected="a COLMAP depth map"
        )
    width, height, channels = map(int, sizes)
    if channels != 1 or width * height < 1 or len(numbers) != 4 * width * height:
        raise InputError(
            f"has {len(numbers)} bytes after {width}&{height}&{channels}&",
            where=path,
            expected=f"{4 * width * height} of one channel",
        )
    values = np.frombuffer(numbers, "<f4").reshape(height, width)
    return depth_image(np.where(values > 0, values, 0), 1.0, f"{path}: depth")


def _images(file: Path) -> list[ModelImage]:
    return _binary(file, _binary_image) if file.suffix == ".bin" else list(_text_images(file))


class _Bytes:
    """A binary file that is parsed from its beginning to its end."""

    def __init__(self, path: Path) -> None:
        self.path, self._content, self._place = path, read_file(path, MODEL_FILE, LARGEST_MODEL), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack_from(layout, self._content, self.skip(struct.calcsize(layout)))

    def array(self, kind: np.dtype, count: int) -> np.ndarray:
        return np.frombuffer(self._content, kind, count, self.skip(kind.itemsize * count))

    def text(self) -> str:
        end = self._content.find(b"\0", self._place)
        start = self.skip((len(self._content) if end < 0 else end + 1) - self._place)
        return self._content[start : self._place - 1].decode("utf-8", "replace")

    @property
    def left(self) -> int:
        return len(self._content) - self._place

    def skip(self, size: int) -> int:
        """Skip ``size`` bytes, and return where they began. Raises ``InputError`` if there are fewer."""
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
    (count,) = file.take("<Q")
    if count > file.left:  # a false count must not allocate memory
        raise InputError(f"declares {count} entries in {file.left} bytes; is the file damaged?", where=path)
    found = [one(file) for _ in range(int(count))]
    if file.left:
        raise InputError(f"{file.left} bytes after its {count} entries", where=path, expected="a COLMAP file")
    return found


def _binary_image(file: _Bytes) -> ModelImage:
    _, *pose, camera = file.take("<I7dI")
    name = file.text()
    keypoint = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
    observed = file.array(keypoint, int(file.take("<Q")[0]))["point"]
    return _image(str(file.path), name, int(camera), pose, observed)


def _binary_point(file: _Bytes) -> _Point:
    number, x, y, z, *_, error, track = file.take("<q3d3BdQ")
    file.skip(8 * int(track))  # an image and one of its keypoints, 4 bytes each
    return int(number), (x, y, z), error, int(track)


def _text_images(path: Path) -> Iterator[ModelImage]:
    """Yield the images of pairs of lines; the second is empty if nothing was observed."""
    rows = iter(read_lines(path, MODEL_FILE, "id, pose, camera and name of an image", LARGEST_MODEL))
    for row in rows:
        if not row.text or row.text.startswith("#"):
            continue
        words = row.text.split(maxsplit=9)  # a name may contain spaces
        if len(words) < 10:
            raise row.error(f" has {len(words)} entries")
        following: Row = replace(next(rows, replace(row, text="")), columns="x, y, id of points")
        observed = following.words
        if len(observed) % 3:
            raise following.error(f" has {len(observed)} entries")
        points = np.array([following.integer(word) for word in observed[2::3]], dtype=np.int64)
        yield _image(row.where, words[9], row.integer(words[8]), row.numbers(words[1:8]), points)


def _text_points(path: Path) -> Iterator[_Point]:
    for row in read_lines(path, MODEL_FILE, "id, x y z, r g b, error and a track", LARGEST_MODEL):
        if not row.text or row.text.startswith("#"):
            continue
        words = row.words
        if len(words) < 8 or len(words) % 2:
            raise row.error(f" has {len(words)} entries")
        x, y, z, error = row.numbers([*words[1:4], words[7]])
        yield row.integer(words[0]), (x, y, z), error, (len(words) - 8) // 2


def _image(where: str, name: str, camera: int, pose: Sequence[float], points: np.ndarray) -> ModelImage:
    """Build an image from a ``pose``, which is a quaternion w x y z followed by a translation."""
    if not (np.isfinite(pose).all() and 0.5 < np.linalg.norm(pose[:4]) < 2):
        raise InputError(f"image {name!r} has an invalid pose", where=where, expected="a unit quaternion")
    rotation = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
    T = SE3(torch.from_numpy(rotation), torch.tensor(pose[4:], dtype=torch.float64))
    return ModelImage(name, camera, T, torch.from_numpy(points.astype(np.int64)))
