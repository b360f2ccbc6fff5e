"""Scans of ScanNet (http://www.scan-net.org), as its ``SensReader`` exports them.

``color/0.jpg`` is an image, ``depth/0.png`` its depth (16-bit planar z in millimetres, of the depth camera), ``pose/0.txt`` its
pose (4x4, camera to world, OpenCV axes, metres; -inf if tracking failed). ``intrinsic/intrinsic_color.txt`` and
``intrinsic_depth.txt`` are the 4x4 matrices of the two cameras, whose principal points are relative to the centre of the upper
left pixel, so half a pixel is added. Depth is registered to the colour camera by them, as in 12-Scenes. Every eighth image with a
pose (the first, the ninth ...) is held out as "test" and the others are "train".
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets.capture import Capture, DepthFile, Shot
from bidnerf_core.datasets.formats.twelve_scenes import FOCAL_TOLERANCE
from bidnerf_core.datasets.pose_rows import read_pose_matrix
from bidnerf_core.datasets.reader import DatasetOptions, OpenQuestion, Reader
from bidnerf_core.depth import MILLIMETRE, DepthCamera, DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import IMAGE_SUFFIXES, is_file, read_header, read_rows

FOLDERS = ("color", "rgb")
INTRINSICS = ("intrinsic/intrinsic_{}.txt", "intrinsic_{}.txt", "intrinsics/intrinsic_{}.txt")


class ScanNetReader(Reader):
    """Reader for exported scans of ScanNet."""

    accepts: tuple[OpenQuestion, ...] = ("register_depth", "depth_unit")
    expected = "color/0.jpg with pose/0.txt and intrinsic/intrinsic_color.txt (ScanNet)"

    def recognises(self, path: Path) -> bool:
        return bool(_images(path)) and (path / "pose").is_dir() and _intrinsics(path, "color") is not None

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the cameras and poses. Raises ``InputError`` if one is invalid."""
        images, colour, depth = _images(path), _intrinsics(path, "color"), _intrinsics(path, "depth")
        assert colour is not None  # ensured by recognises
        measured = sorted((path / "depth").glob("[!.]*.png"), key=lambda file: natural_order(file.name))
        camera = _camera(colour, images[0])
        own = None if depth is None or not measured else _camera(depth, measured[0])
        same = (
            own is not None
            and abs(own.resized(camera.width, camera.height).fx / camera.fx - 1) < FOCAL_TOLERANCE
        )
        registered = None if own is None or same else DepthCamera(own, SE3.identity())
        sensor, unit = options.sensor(path, registered), options.depth_unit or MILLIMETRE
        read = DepthReader(documented=("65535",))
        by_stem, shots = {file.stem: file for file in measured}, list[Shot]()
        for image in images:
            pose, file = path / "pose" / f"{image.stem}.txt", by_stem.get(image.stem)
            shots.append(
                Shot(
                    image=image,
                    camera=camera,
                    T_world_camera=read_pose_matrix(pose) if is_file(pose) else None,
                    depth=None if file is None else DepthFile(file, partial(read, file, unit), sensor),
                )
            )
        return Capture(
            path, shots, options.colour, unit="metres", depth_unit=unit, pose_file=path / "pose",
            poses_expected="NUMBER.txt of finite numbers for each image",
        )  # fmt: skip


def _images(path: Path) -> list[Path]:
    found = (
        file
        for name in FOLDERS
        for file in (path / name).glob("[!.]*")
        if file.suffix.lower() in IMAGE_SUFFIXES
    )
    return sorted(found, key=lambda file: natural_order(file.name))


def _intrinsics(path: Path, kind: str) -> Path | None:
    return next((file for name in INTRINSICS if is_file(file := path / name.format(kind))), None)


def _camera(file: Path, image: Path) -> Intrinsics:
    """Return the camera of the images that are like ``image``."""
    expected = "a matrix of intrinsics, 3x3 or 4x4"
    rows = [row.numbers() for row in read_rows(file, "ScanNet's intrinsics", expected)]
    if len(rows) < 3 or any(len(row) < 3 for row in rows):
        raise InputError(f"has {len(rows)} rows", where=file, expected=expected)
    header = read_header(image)
    try:
        (fx, _, cx, *_), (_, fy, cy, *_) = rows[:2]
        return Intrinsics(fx, fy, cx + 0.5, cy + 0.5, header.width, header.height)
    except InputError as error:
        raise InputError(error, where=file) from error


reader = ScanNetReader()
