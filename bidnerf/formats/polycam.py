"""Raw data exported by the iOS app Polycam (https://github.com/PolyCam/polyform): folders with ``keyframes``.

``keyframes/cameras/TIME.json`` has ``fx fy cx cy width height`` and ``t_00`` to ``t_23``, the rows of ARKit's
camera-to-world matrix (OpenGL axes, +y up); TIME is in microseconds. ``keyframes/corrected_cameras`` and
``corrected_images`` have the poses after global optimization and undistorted photos; they are used if they
exist, otherwise ``cameras`` and ``images``. Newer exports store no size, so the photo's size is used.
``keyframes/depth/TIME.png`` is planar z in millimetres at a lower resolution, with
``keyframes/confidence/TIME.png`` (0 low, 127 medium, 255 high). See ``lidar`` for how both are read.

Undistorted photos have a black border, which must not be learned: 15 pixels of it are hidden, the width
that other software crops.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf.formats import lidar
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    DepthFile,
    FileNames,
    Format,
    Shot,
    camera_of,
    pose_of_rows,
    warn_about,
)
from bidnerf_core.errors import amount
from bidnerf_core.frames import photos_in
from bidnerf_core.io import is_file, read_header, read_record

LENS_KEYS = ("fx", "fy", "cx", "cy")
POSE_KEYS = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]


def _read(path: Path, cameras: Path, options: DatasetOptions) -> Capture:
    """Read the cameras. Raises ``InputError`` if one is invalid."""
    images = cameras.with_name(cameras.name.replace("cameras", "images"))
    corrected = cameras.name != "cameras"
    if not corrected:
        warn_about(
            path,
            "has no corrected_cameras, so the poses are ARKit's, which drift; Polycam can correct them on export",
        )
    files, photos = {file.stem: file for file in cameras.glob("[!.]*.json")}, photos_in(images)[0]
    if left := sum(photo.stem not in files for photo in photos):
        warn_about(
            images, f"{left} of {amount(len(photos), 'photo')} have no camera in {cameras.name} and are left out"
        )
    read_depth, has_depth = lidar.LidarDepth((lidar.HIGH_CONFIDENCE, 255)), (cameras.parent / "depth").is_dir()

    def read(photo: Path, time: str, file: Path) -> Shot:
        record = read_record(file)
        rows = [[record.number(key) for key in row] for row in POSE_KEYS]
        lens = [number for key in LENS_KEYS if (number := record.number(key)) is not None]
        if len(lens) < len(LENS_KEYS) or any(number is None for row in rows for number in row):
            raise record.error(
                "is incomplete", expected="fx, fy, cx, cy, and t_00 to t_23, the rows of the camera's pose"
            )
        width, height = record.size("width"), record.size("height")
        depth, confidence = (cameras.parent / kind / f"{time}.png" for kind in ("depth", "confidence"))
        measured = partial(read_depth, depth, confidence if is_file(confidence) else None)
        return Shot(
            image=photo,
            # Newer exports do not store the size.
            camera=camera_of(str(file), lens, (width, height) if width and height else read_header(photo).size),
            T_world_camera=pose_of_rows(record, "t_00 to t_23", rows),
            time=int(time) / 1_000_000 if time.isdecimal() else None,
            depth=DepthFile(depth, measured) if has_depth else None,
            border=15 if corrected else 0,  # pixels that are black in undistorted photos
            folders=(),
            usual_side=lidar.LARGEST_SIDE,
        )

    shots = FileNames(images).shots(files, read)
    return Capture(path, shots, options.colour, unit="metres", up=lidar.UP, pose_file=cameras)


def _find(path: Path) -> Path | None:
    """Return the camera folder that has a photo folder beside it, ignoring hidden files such as ``._NAME`` from macOS."""
    folders = ((base, prefix) for prefix in ("corrected_", "") for base in (path / "keyframes", path))
    found = (base / f"{prefix}cameras" for base, prefix in folders if (base / f"{prefix}images").is_dir())
    return next((cameras for cameras in found if any(cameras.glob("[!.]*.json"))), None)


reader = Format(
    "raw data of Polycam: optimized poses first, depth of confidence 255 up to 5 m",
    "keyframes/images and keyframes/cameras, or the corrected ones (Polycam, raw data)",
    _find,
    _read,
    precedence=30,  # a recording with metric poses
)
