"""The files of a COLMAP sparse model: ``cameras``, ``images`` and ``points3D``, as .bin or .txt; depth maps; and keypoints.

Formats: https://colmap.github.io/format.html. Poses are ``cam_from_world`` with OpenCV's camera axes. The
files ``rigs`` and ``frames`` of newer versions are not needed, since these versions still write each image's
pose to ``images``. pycolmap is not used because it hangs on a truncated ``points3D.bin``. A depth map is the text
``width&height&channels&``, then 32-bit floats, row by row: planar z of the undistorted image in units of the model, 0
where nothing was reconstructed.

Keypoints with descriptors are in COLMAP's database or the features of hloc (.h5), in the order in which the model lists an
image's observations. COLMAP's SIFT descriptors have the same root normalisation and layout as ours, so the two can be
matched; COLMAP's scale is half of our diameter. The centre of the first pixel is (0, 0) in hloc's keypoints and
(0.5, 0.5) in COLMAP's.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from bidnerf_core.camera import MODELS, Camera, colmap_camera, read_text_cameras
from bidnerf_core.depth import DepthImage, depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_file, library_errors, open_arrays, read_database_table, read_file, read_lines
from bidnerf_core.mapping import FIRST_CENTRE, Keypoints, quantize

MODEL_FILE = "a file of a COLMAP sparse model"
LARGEST_MODEL = 2**30  # bytes of one file of a model
UNKNOWN_SCALE = 4.0
"""Scale (pixels) assumed for keypoints that are stored without one."""


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
    """All triangulated points of a model, ordered by id."""

    ids: Int[Tensor, "p"]
    positions: Float[Tensor, "p 3"]  # model frame, in units of the model
    errors: Float[Tensor, "p"]  # mean reprojection error, pixels; negative where it was never computed
    tracks: Int[Tensor, "p"]  # number of observations

    def rows(self, ids: Int[Tensor, "n"], chosen: Bool[Tensor, "p"]) -> Int[Tensor, "n"]:
        """Return the indices of the points with these ids; -1 for ids that are unknown or of points that are not ``chosen``."""
        if not len(self.ids):
            return torch.full_like(ids, -1)
        index = torch.searchsorted(self.ids, ids).clamp(max=len(self.ids) - 1)
        return torch.where((self.ids[index] == ids) & chosen[index], index, -1)


def read_model(folder: Path) -> tuple[list[ModelImage], ModelPoints]:
    """Read the model in ``folder``. Raises ``InputError`` if there is no model, or if a file is damaged."""
    images, points = files_of(folder, "images", "points3D") or (None, None)
    if images is None or points is None:
        raise InputError(
            "no COLMAP sparse model in it",
            where=folder,
            expected="images.bin and points3D.bin, or the same as .txt, as in sparse/0 of a project",
        )
    found = sorted((n[0], n[1:4], n[7], len(track)) for _, n, _, track in _entries(points, POINT_RECORDS))
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

    Raises ``InputError`` if there is no model, if a file is damaged, and for a camera of an unknown model.
    """
    files = files_of(folder, "cameras", "images")
    if files is None:
        raise InputError("no cameras and images of a COLMAP sparse model", where=folder, expected=".bin or .txt")
    cameras, images = files
    if cameras.suffix == ".txt":
        return _images(images), read_text_cameras(cameras)
    found = dict[int, Camera]()
    for where, (number, model, width, height), _, parameters in _entries(cameras, CAMERA_RECORDS):
        name = next(name for name, (known, _, _) in MODELS.items() if known == model)
        found[number] = colmap_camera(f"{where}: camera {number}", name, width, height, parameters.tolist())
    return _images(images), found


def files_of(folder: Path, *names: str) -> list[Path] | None:
    """Return the files of a model with these names, either all .bin or all .txt; None if any is missing."""
    found = ([folder / f"{name}{suffix}" for name in names] for suffix in (".bin", ".txt"))
    return next((files for files in found if all(map(is_file, files))), None)


def depth_map_of(model: Path, name: str) -> Path | None:
    """Return the depth map of an image of a model ``WORKSPACE/sparse`` or ``WORKSPACE/sparse/0``, or None."""
    files = (
        folder / f"stereo/depth_maps/{name}.{kind}.bin"
        for folder in (model.parent, model.parent.parent)
        for kind in ("geometric", "photometric")  # the more reliable one first
    )
    return next(filter(is_file, files), None)


def read_colmap_depth(path: Path) -> DepthImage:
    """Read a depth map, in units of the model. Raises ``InputError`` for a truncated file and for any other format."""
    *sizes, numbers = read_file(path, "a COLMAP depth map").split(b"&", 3)
    if len(sizes) != 3 or not all(size.isdigit() and len(size) < 10 for size in sizes):
        raise InputError("does not begin with width&height&channels&", where=path, expected="a COLMAP depth map")
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
    images = list[ModelImage]()
    for where, (_, *pose, camera), name, observed in _entries(file, IMAGE_RECORDS):
        quaternion, translation = pose[:4], pose[4:]
        if not (np.isfinite(pose).all() and 0.5 < np.linalg.norm(quaternion) < 2):
            raise InputError(f"image {name!r} has an invalid pose", where=where, expected="a unit quaternion")
        rotation = torch.from_numpy(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())
        images.append(
            ModelImage(
                name,
                camera,
                SE3(rotation, torch.tensor(translation, dtype=torch.float64)),
                torch.from_numpy(observed.astype(np.int64)),
            )
        )
    return images


@dataclass(frozen=True)
class _Columns:
    """The layout of a file's entries: numbers, an image name, and a list, of which only the last column is used."""

    numbers: str  # as ``struct`` names them
    item: np.dtype  # of the list
    text: str  # the columns, for messages
    item_text: str = ""  # of the list if it has a line of its own in text files, which then follows a name
    length: Callable[[Path, Sequence[Any]], int] | None = None
    """Returns the length of the list for the numbers; by default it precedes the list."""


def _parameters(path: Path, numbers: Sequence[Any]) -> int:
    """Return the number of parameters of a camera. Raises ``InputError`` for an unknown model."""
    number, model, *_ = numbers
    for known, _, places in MODELS.values():
        if known == model:
            return max(places) + 1
    raise InputError(
        f"camera {number} has the model {model}",
        where=path,
        expected=f"one of {', '.join(MODELS)}; undistort the images with COLMAP",
    )


CAMERA_RECORDS = _Columns("IiQQ", np.dtype([("parameter", "<f8")]), "", length=_parameters)
IMAGE_RECORDS = _Columns(
    "IdddddddI",
    np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")]),
    "id, pose, camera and name of an image",
    "x, y, id of points",
)
POINT_RECORDS = _Columns(
    "qdddBBBd", np.dtype([("image", "<u4"), ("keypoint", "<u4")]), "id, x y z, r g b, error and a track"
)
_Entry: TypeAlias = tuple[str, list[Any], str, np.ndarray]
"""Where an entry is, its numbers, the name of the image, and the last column of its list."""


def _entries(path: Path, columns: _Columns) -> Iterator[_Entry]:
    return (_binary if path.suffix == ".bin" else _text)(path, columns)


def _binary(path: Path, columns: _Columns) -> Iterator[_Entry]:
    content = read_file(path, MODEL_FILE, LARGEST_MODEL)
    file = io.BytesIO(content)

    def take(size: int) -> bytes:
        if len(found := file.read(min(size, len(content)))) < size:  # a wrong size may exceed the memory
            raise InputError(f"ends too early, at byte {len(content)};", where=path, expected="a complete COLMAP file")
        return found

    def unpack(layout: str) -> tuple[Any, ...]:
        return struct.unpack(f"<{layout}", take(struct.calcsize(f"<{layout}")))

    (count,) = unpack("Q")
    if count > len(content) - 8:
        raise InputError(f"declares {count} entries in {len(content) - 8} bytes; is the file damaged?", where=path)
    for _ in range(count):
        numbers = list(unpack(columns.numbers))
        name = b"".join(iter(partial(take, 1), b"\0")) if columns.item_text else b""
        length = unpack("Q")[0] if columns.length is None else columns.length(path, numbers)
        items = np.frombuffer(take(length * columns.item.itemsize), columns.item)
        yield str(path), numbers, name.decode("utf-8", "replace"), items[columns.item.names[-1]]  # type: ignore[index]
    if left := len(content) - file.tell():
        raise InputError(f"{left} bytes after its {count} entries", where=path, expected="a COLMAP file")


def _text(path: Path, columns: _Columns) -> Iterator[_Entry]:
    count, step = len(columns.numbers), len(columns.item.names or ())
    rows = iter(read_lines(path, MODEL_FILE, columns.text, LARGEST_MODEL))
    for row in rows:
        if not row.text or row.text.startswith("#"):
            continue
        last, name, words = row, "", row.words
        if columns.item_text:  # the list is empty if nothing was observed; a name may contain spaces
            words = row.text.split(maxsplit=count)
            name = words[-1]
            last = replace(next(rows, replace(row, text="")), columns=columns.item_text)
        if len(words) < count + bool(columns.item_text):
            raise row.error(f" has {len(words)} entries")
        items = last.words if columns.item_text else words[count:]
        if len(items) % step:
            raise last.error(f" has {len(last.words)} entries")
        kinds = list(zip(columns.numbers, words, strict=False))
        reals = iter(row.numbers([word for kind, word in kinds if kind == "d"]))
        numbers = [next(reals) if kind == "d" else row.integer(word) for kind, word in kinds]
        column = np.array([last.integer(word) for word in items[step - 1 :: step]], dtype=np.int64)
        yield row.where, numbers, name, column


def stored_keypoints(path: Path, names: Iterable[str]) -> dict[str, Keypoints]:
    """Return the keypoints of those of the images ``names`` that a database or (with the extension .h5) a feature file knows.

    Raises ``InputError`` for a file that cannot be read, and if h5py, required for hloc features, is not installed.
    """
    found = dict[str, Keypoints]()
    for name, pixels, scales, descriptors in (_of_features if path.suffix == ".h5" else _of_database)(path, names):
        count, arrays = len(pixels), (pixels, scales, descriptors)
        ranks = pixels.ndim == descriptors.ndim == 2 and pixels.shape[1] >= 2
        if not (ranks and scales.shape == (count,) and len(descriptors) == count):
            raise InputError(
                f"image {name!r} has {', '.join(str(list(array.shape)) for array in arrays)} numbers",
                where=path,
                expected=f"{count} keypoints (x, y), scales and descriptors",
            )
        if not (all(bool(np.isfinite(array).all()) for array in arrays) and (scales > 0).all()):
            raise InputError(f"image {name!r} has keypoints of NaN", where=path, expected="finite numbers")
        # OpenCV's diameter of a keypoint is twice the scale of the Gaussian at which it was found.
        sizes = torch.from_numpy(2 * np.asarray(scales, dtype=np.float32))
        numbers = torch.from_numpy(np.array(descriptors))
        if numbers.dtype != torch.uint8:
            numbers = quantize(numbers.float())
        found[name] = Keypoints(torch.from_numpy(np.array(pixels[:, :2], dtype=np.float32)), sizes, numbers)
    return found


_Stored: TypeAlias = Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]
"""The names of images with their keypoints, scales and descriptors."""


def _of_database(path: Path, names: Iterable[str]) -> _Stored:
    expected, columns, known = "a database of COLMAP", ("image_id", "rows", "cols", "data"), set(names)
    by_number = {
        number: name
        for number, name in read_database_table(path, "images", ("image_id", "name"), expected)
        if name in known
    }
    keypoints = {
        number: row for number, *row in read_database_table(path, "keypoints", columns, expected) if number in by_number
    }
    for number, *row in read_database_table(path, "descriptors", columns, expected):
        if number in keypoints:
            with library_errors(path, f"image {by_number[number]!r} is damaged", expected, ValueError, TypeError):
                of_image, descriptors = (
                    np.frombuffer(data or b"", kind).reshape(rows, count)
                    for (rows, count, data), kind in ((keypoints[number], "<f4"), (row, "u1"))
                )
            yield by_number[number], of_image, _scales(of_image), descriptors


def _scales(keypoints: np.ndarray) -> np.ndarray:
    """Return the scales of keypoints stored as (x, y), (x, y, scale, orientation) or (x, y, 2x2 affine shape)."""
    if keypoints.shape[1] == 6:
        a, b, c, d = keypoints[:, 2:].T
        return np.sqrt(np.abs(a * d - b * c)).clip(1e-3)
    if keypoints.shape[1] == 4:
        return keypoints[:, 2].clip(1e-3)
    return np.full(len(keypoints), UNKNOWN_SCALE, dtype=np.float32)


def _of_features(path: Path, names: Iterable[str]) -> _Stored:
    with open_arrays(path, "features of hloc") as read:
        for name in names:
            parts = PurePosixPath(name).parts  # folders in an image name are nested groups
            pixels, scales, descriptors = (read(*parts, key) for key in ("keypoints", "scales", "descriptors"))
            if pixels is not None and descriptors is not None:
                scales = np.full(len(pixels), UNKNOWN_SCALE) if scales is None else scales
                yield name, pixels + np.float32(FIRST_CENTRE), scales, descriptors.T.astype(np.float32)
