"""Raw data exported by the iOS app Polycam (https://github.com/PolyCam/polyform): folders with ``keyframes``.

``keyframes/cameras/TIME.json`` has ``fx fy cx cy width height`` and ``t_00`` to ``t_23``, the rows of ARKit's
camera-to-world matrix (OpenGL axes, +y up); TIME is in microseconds. ``keyframes/corrected_cameras`` and
``corrected_images`` have the poses after global optimization and undistorted photos; they are used if they
exist, else ``cameras`` and ``images``. Newer exports store no size, so the photo's size is used.
``keyframes/depth/TIME.png`` is planar z in millimetres at a lower resolution, with
``keyframes/confidence/TIME.png`` (0 low, 127 medium, 255 high). See ``lidar`` for how both are read.

Undistorted photos have a black border, which must not be learned: 15 pixels of it are hidden, the width that
other software crops. Every eighth photo (the first, the ninth ...) is held out as "test" and the others are
"train".
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf_core.datasets import lidar
from bidnerf_core.datasets.capture import Capture, DepthFile, Shot, present, remark
from bidnerf_core.datasets.pose_rows import pose_of_rows
from bidnerf_core.datasets.reader import DatasetOptions, Reader
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import natural_order
from bidnerf_core.io import is_file, read_header, read_record

BORDER = 15
"""Width in pixels of the hidden border of an undistorted photo."""
HIGH_CONFIDENCE = 255
MICROSECONDS = 1_000_000
SUFFIXES = (".jpg", ".jpeg", ".png")
LENS = ("fx", "fy", "cx", "cy")
POSE = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]


class PolycamReader(Reader):
    """Reader for Polycam's raw data."""

    expected = "keyframes/images and keyframes/cameras, or the corrected ones (Polycam, raw data)"

    def recognises(self, path: Path) -> bool:
        return any(_folders(path, corrected) is not None for corrected in (True, False))

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the cameras. Raises ``InputError`` if one is invalid, and if no photo has one."""
        found = _folders(path, True)
        corrected = found is not None
        found = found or _folders(path, False)
        assert found is not None  # ensured by recognises
        if not corrected:
            remark(
                path,
                "has no corrected_cameras, so the poses are ARKit's, which drift; Polycam can correct them on"
                " export",
            )
        images, cameras = found
        descriptions = sorted(_described(cameras), key=lambda file: natural_order(file.name))
        photos = {
            file.stem: file
            for file in images.iterdir()
            if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")
        }
        there = present(
            descriptions,
            lambda file: file.stem in photos,
            images,
            lambda file: f"{file.stem}.jpg",
            lambda file: InputError(
                f"no such file, although {file} exists", where=f"{images / file.stem}.jpg"
            ),
            noun="photo",
        )
        if alone := len(photos) - len(there):
            count = amount(len(photos), "photo")
            remark(images, f"{alone} of {count} have no camera in {cameras.name} and are left out")
        read = lidar.LidarDepth((lidar.HIGH_CONFIDENCE, HIGH_CONFIDENCE))
        shots = [_shot(file, photos[file.stem], read, BORDER if corrected else 0) for file in there]
        measured = sum(shot.depth is not None for shot in shots)
        if 0 < measured < len(shots):
            remark(path, f"{len(shots) - measured} of {amount(len(shots), 'photo')} have no depth")
        up = (0.0, 1.0, 0.0)  # ARKit aligns its world with gravity
        return Capture(path, shots, options.colour, unit="metres", up=up, pose_file=cameras)


def _folders(path: Path, corrected: bool) -> tuple[Path, Path] | None:
    """Return the folders of photos and cameras, or None if one of them is missing or empty."""
    prefix = "corrected_" if corrected else ""
    for base in (path / "keyframes", path):
        images, cameras = base / f"{prefix}images", base / f"{prefix}cameras"
        if images.is_dir() and cameras.is_dir() and _described(cameras):
            return images, cameras
    return None


def _described(cameras: Path) -> list[Path]:
    """Return the descriptions of cameras in a folder, without hidden files such as the companions ``._NAME`` of a Mac."""
    return [file for file in cameras.glob("*.json") if not file.name.startswith(".")]


def _shot(description: Path, photo: Path, read: lidar.LidarDepth, border: int) -> Shot:
    record, time = read_record(description), description.stem
    rows = [[record.number(key) for key in row] for row in POSE]
    missing = [key for row in POSE for key in row if record.number(key) is None]
    if missing:
        raise record.error(f"no {missing[0]}", expected="t_00 to t_23, the rows of the camera's pose")
    numbers = [record.number(key) for key in LENS]
    if None in numbers:
        raise record.error(f"no {LENS[numbers.index(None)]}", expected="fx, fy, cx and cy")
    width, height = record.size("width"), record.size("height")
    if width is None or height is None:  # as in newer exports
        header = read_header(photo)
        width, height = width or header.width, height or header.height
    files = [description.parents[1] / kind / f"{time}.png" for kind in ("depth", "confidence")]
    depth, confidence = (file if is_file(file) else None for file in files)
    return Shot(
        image=photo,
        camera=lidar.arkit_camera([number or 0.0 for number in numbers], width, height, str(description)),
        T_world_camera=pose_of_rows(record, "t_00 to t_23", rows),
        time=int(time) / MICROSECONDS if time.isdecimal() else None,
        depth=None if depth is None else DepthFile(depth, partial(read, depth, confidence)),
        border=border,
        folders=(),
        usual_side=lidar.LARGEST_SIDE,
    )


reader = PolycamReader()
