"""Files of estimated poses: TUM trajectories, JSON with covariances, and ``transforms.json`` for nerfstudio.

``colmap_poses`` writes COLMAP models.
"""

from __future__ import annotations

import inspect
import json
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf.results.pose_formats import POSE_WRITERS, pose_format, refused_file
from bidnerf_core.camera import UPRIGHT, Intrinsics, Orientation, read_exif
from bidnerf_core.datasets import frame_entry
from bidnerf_core.errors import InputError, printable, spelling_hint
from bidnerf_core.geometry import SE3, LengthUnit, pose_from_matrix
from bidnerf_core.io import parse_json, read_file, write_file

OPENCV_AXES = "camera axes x right, y down, z forward (OpenCV)"
EXPECTED_POSE = '{"T_world_camera": 4x4 rows}'
EXPECTED_POSITIONS = '{"NAME": [x, y, z], ...} or [{"frame": "NAME", "T_world_camera": 4x4 rows}, ...]'


@dataclass(frozen=True, eq=False)
class LandmarkMatches:
    """The keypoints of an image that agree with landmarks of its map."""

    pixels: Float[Tensor, "m 2"]  # of the upright image
    landmark: Int[Tensor, "m"]  # index in the map's landmarks
    positions: Float[Tensor, "m 3"]  # of the landmarks, world


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image with its camera and an estimated pose."""

    name: str
    number: int  # index in the run or sequence, from 0
    intrinsics: Intrinsics  # of the upright image
    T_world_camera: SE3  # OpenCV axes
    file: Path | None = None
    time: float | None = None  # seconds
    # Of the tangent at the camera (translation in ``unit``, rotation in rad).
    covariance: Float[Tensor, "6 6"] | None = None
    unit: LengthUnit = "units"  # of the position
    orientation: Orientation | None = None  # how the stored image was turned upright; None: according to EXIF
    matches: LandmarkMatches | None = None
    interval: float = 1.0  # seconds between images, assumed where there are no times

    def __post_init__(self) -> None:
        if self.time is not None and not math.isfinite(self.time):
            raise InputError(f"the time of {self.name} is {self.time}", expected="seconds, or None if it is unknown")

    @property
    def pose(self) -> SE3:
        """T_world_camera in float64, on the CPU. Raises ``InputError`` if it is not finite."""
        pose = self.T_world_camera.to("cpu", torch.float64)
        if not pose.is_finite:
            raise InputError(f"the pose of {self.name} is not finite", expected="to leave it out, or a .json file")
        return pose

    @property
    def as_stored(self) -> PosedImage:
        """This image in the orientation stored in its file, which may not be upright.

        Without a file and an orientation, the image is returned as it is. Raises ``InputError`` for a photo
        stored mirrored, for which no rigid pose exists.
        """
        orientation = self.orientation or (UPRIGHT if self.file is None else read_exif(self.file).orientation)
        if orientation == UPRIGHT:
            return self
        if float(torch.linalg.det(orientation.axes)) < 0:
            raise InputError("is stored mirrored, which this format cannot describe", where=self.file)
        x_flips, y_flips = orientation.mirrors_columns, orientation.mirrors_rows
        inverse = Orientation(y_flips, x_flips, True) if orientation.transposes else orientation
        T_upright_stored = SE3(orientation.axes, torch.zeros(3, dtype=torch.float64))
        stored, matches = self.intrinsics.upright(inverse), self.matches
        if matches is not None:
            rays = T_upright_stored.inverse().rotate(self.intrinsics.unproject(matches.pixels))
            matches = replace(matches, pixels=stored.project(rays))
        return replace(self, intrinsics=stored, T_world_camera=self.pose @ T_upright_stored, matches=matches)


def common_unit(parts: Sequence[Any]) -> LengthUnit:
    """Return the unit of the lengths of images or results, each of which has a ``unit``: metres only if all are metric."""
    return "metres" if parts and all(part.unit == "metres" for part in parts) else "units"


def frame_of(images: Sequence[PosedImage], direction: str = "camera to world") -> str:
    """Return a description of the poses for a file header: direction, axes, and the unit of lengths if there are poses."""
    if not images:
        return f"{direction}, {OPENCV_AXES}"
    lengths = "metres" if common_unit(images) == "metres" else "units of the map (not known to be metres)"
    return f"{direction}, {OPENCV_AXES}, lengths in {lengths}"


def time_stamps(images: Sequence[PosedImage]) -> tuple[list[tuple[float, PosedImage]], bool]:
    """Return the images with their time stamps (seconds) in ascending order, and whether the stamps are times.

    Trajectory formats need stamps that increase. A time is that of the image or, as in the TUM RGB-D data sets, its
    name, if that is a number with a fraction. If an image has neither, or two have the same time, the stamps are the
    numbers of the images times the ``interval`` that is assumed between them.
    """
    times = dict[float, PosedImage]()
    for image in images:
        is_time = image.time is None and re.fullmatch(r"\d+\.\d+", image.name)
        time = float(image.name) if is_time else image.time
        if time is not None:
            times[round(time, 6)] = image
    are_times = len(times) == len(images)
    stamped = times.items() if are_times else [(image.number * image.interval, image) for image in images]
    return sorted(stamped, key=lambda pair: pair[0]), are_times


def write_tum(path: Path, images: Sequence[PosedImage], refused: Sequence[str] = ()) -> None:
    """A TUM trajectory: rows of time stamp, position, and unit quaternion with the scalar last.

    See ``time_stamps`` and https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats. If the stamps are not
    times, a comment before each row names the image, since other programs skip comments.
    """
    stamped, are_times = time_stamps(images)
    rows = [
        f"# timestamp tx ty tz qx qy qz qw ({frame_of(images)})",
        *(f"# without a pose: {printable(each)}" for each in refused),
    ]
    for stamp, image in stamped:
        if not are_times:
            rows.append(f"# {printable(image.name if image.file is None else image.file.name)}")
        numbers = (*image.pose.translation.tolist(), *image.pose.quaternion("xyzw").tolist())
        digits = 0 if not are_times and image.interval == 1 else 6
        rows.append(" ".join((f"{stamp:.{digits}f}", *(f"{number:.12g}" for number in numbers))))
    write_file(path, "\n".join([*rows, ""]).encode())


def write_pose_json(path: Path, images: Sequence[PosedImage]) -> None:
    """A JSON list of poses with OpenCV axes, times and covariances.

    Each line holds an object with "frame", "time", "T_world_camera", "covariance" and "unit".
    ``time`` (seconds) and ``covariance`` (6x6, tangent of translation in ``unit``, then rotation in rad, at
    the camera) are null if unknown, and every matrix is null if it is not finite.
    """
    entries = []
    for image in images:
        matrices = {"T_world_camera": image.T_world_camera.matrix(), "covariance": image.covariance}
        rows = {
            key: None if m is None or not bool(m.isfinite().all()) else m.double().cpu().tolist()
            for key, m in matrices.items()
        }
        entry = {"frame": image.name, "time": image.time, **rows, "unit": image.unit}
        entries.append(json.dumps(entry, allow_nan=False))
    write_file(path, ("[\n" + ",\n".join(entries) + "\n]\n").encode())


def write_pose_transforms(path: Path, images: Sequence[PosedImage], **more: Any) -> None:
    """A dataset in nerfstudio's format: poses with OpenGL axes, and one camera per image.

    Each ``file_path`` is relative to the folder of the file, and ``more`` holds further entries. The entries
    describe the image files as stored, so the poses and cameras of photos with an EXIF orientation are rotated.
    Raises ``InputError`` for a photo stored mirrored, for which no rigid pose exists.
    """
    frames = []
    for image in images:
        stored, folder = image.as_stored, path.parent.resolve()
        file = image.name if image.file is None else os.path.relpath(image.file.resolve(), folder)
        frames.append(frame_entry(Path(file).as_posix(), image.name, stored.intrinsics, stored.pose, image.time))
    content = {"camera_model": "OPENCV", "unit": common_unit(images), "frames": frames, **more}
    write_file(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def write_poses(path: str | Path, images: Sequence[PosedImage], refused: Sequence[str] = ()) -> None:
    """Write poses in the format selected by the file-name ending.

    Formats with comments list the ``refused`` images, which are lines of text. A text file beside it, such as "path.refused.txt", names them in a line each;
    one of an earlier run is replaced. Raises ``InputError`` for an unknown ending, and for images that are not ``PosedImage``.
    """
    path = Path(path)
    is_list = isinstance(images, Sequence)
    if odd := [image for image in images if not isinstance(image, PosedImage)] if is_list else [images]:
        raise InputError(
            f"got a {type(odd[0]).__name__}",
            where=path,
            expected="a list of PosedImage(name, number, intrinsics, T_world_camera)",
        )
    ending = pose_format(path)
    write: Any = POSE_WRITERS[ending]
    more = {"refused": refused} if "refused" in inspect.signature(write).parameters else {}
    write(path, images, **more)
    beside = refused_file(path)
    if refused or beside.exists():
        write_file(beside, "".join(f"{printable(each)}\n" for each in refused).encode())


def read_pose(path: str | Path) -> SE3:
    """Read a 4x4 camera-to-world matrix, alone or under "T_world_camera", as printed by ``localize --json``.

    A list with one such object is accepted as well. Raises ``InputError`` unless the file holds the rows of a
    rigid transform.
    """
    poses = read_poses(path)
    if len(poses) != 1:
        raise InputError(f"holds {len(poses)} poses", where=path, expected="one")
    return next(iter(poses.values()))


def read_poses(path: str | Path) -> dict[str, SE3]:
    """Read poses T_world_camera by frame name, as ``localize`` writes them with ``--out`` or prints them with ``--json``.

    The file holds one object, a list of objects, or one object per line; objects with a null pose are left
    out. A single pose may be unnamed; its name is then empty. Raises ``InputError`` if a matrix is not a
    rigid transform, or a name occurs twice.
    """
    path = Path(path)
    entries = pose_entries(path, read_file(path, "a pose file"))
    poses = dict[str, SE3]()
    for entry in entries:
        rows = entry.get("T_world_camera") if isinstance(entry, dict) else entry
        name = entry.get("frame", "") if isinstance(entry, dict) else ""
        if rows is None and len(entries) > 1:
            continue
        if not isinstance(name, str) or (not name and len(entries) > 1):
            raise InputError(
                f"holds {len(entries)} poses", where=path, expected='one, or a name under "frame" for each'
            )
        if name in poses:
            raise InputError(f"holds two poses of frame {name!r}", where=path, expected="one")
        poses[name] = pose_from_matrix(_numbers(str(path), rows, EXPECTED_POSE), "T_world_camera", str(path))
    if not poses:
        raise InputError("holds no pose", where=path, expected=EXPECTED_POSE)
    return poses


def read_positions(path: str | Path) -> dict[str, Float[Tensor, "3"]]:
    """Read the positions (float64) of cameras by name.

    The file holds one object that maps names to x, y and z or to 4x4 rows, or it holds poses as for
    ``read_poses``. Raises ``InputError`` for anything else.
    """
    path = Path(path)
    try:
        entries = pose_entries(path, read_file(path, "a pose file"))
        given = entries[0] if len(entries) == 1 and isinstance(entries[0], dict) else {}
        if not given or "T_world_camera" in given:
            return {name: pose.translation for name, pose in read_poses(path).items()}
        numbers = {name: _numbers(str(path), value, EXPECTED_POSITIONS) for name, value in given.items()}
        return {
            name: x if x.shape == (3,) else pose_from_matrix(x, repr(name), path).translation
            for name, x in numbers.items()
        }
    except InputError as error:
        raise InputError(error, expected=EXPECTED_POSITIONS) from error


def _numbers(where: str, values: Any, expected: str) -> Tensor:
    try:
        numbers = torch.tensor(values, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError("contains no matrix of numbers", where=where, expected=expected) from error
    if not bool(numbers.isfinite().all()):
        raise InputError("holds numbers that are NaN or infinite", where=where, expected=expected)
    return numbers


def pose_of(poses: dict[str, SE3], name: str, path: str | Path) -> SE3:
    """Return the pose of an image from the poses of a file; if there is only one, it applies to every image.

    Raises ``InputError`` if the file has several poses, but none of that name.
    """
    if len(poses) == 1:
        return next(iter(poses.values()))
    if name not in poses:
        raise InputError(f"no pose named {name!r} among its {len(poses)}{spelling_hint(name, poses)}", where=path)
    return poses[name]


def pose_entries(path: Path, text: bytes) -> list[Any]:
    """Return the objects in a pose file, or its single matrix, as a list."""
    try:
        content = parse_json(text, str(path), EXPECTED_POSE)
    except InputError:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) < 2 or not all(line.startswith(b"{") for line in lines):
            raise
        return [parse_json(line, f"{path}: line {n}", EXPECTED_POSE) for n, line in enumerate(lines, 1)]
    if isinstance(content, list) and all(isinstance(entry, dict) for entry in content):
        return content
    return [content]
