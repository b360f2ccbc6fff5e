"""Recordings of the iOS app Record3D: ``.r3d`` files, or folders with their unpacked content.

A ``.r3d`` file is a zip archive. ``metadata`` is JSON: ``w h`` (of the photos) and ``dw dh`` (of depth),
``K`` (column by column), ``perFrameIntrinsicCoeffs`` (``fx fy cx cy`` of each frame, in newer recordings),
``poses`` (``qx qy qz qw tx ty tz``, camera to world, OpenGL axes), ``frameTimestamps`` (seconds) or ``fps``.
Frame N has ``rgbd/N.jpg``, ``rgbd/N.depth`` (32-bit floats in metres, row by row, compressed with LZFSE) and,
from a lidar, ``rgbd/N.conf`` (one byte of confidence per pixel, compressed too). Reading depth needs the
package ``lzfse``, which the extra ``record3d`` installs. The export as EXR files has ``metadata.json``, ``rgb/N.jpg`` and
``depth/N.exr``, of which depth is not read. The world frame is the recording's, usually
the camera frame of the first image, so none of its axes is vertical. See ``lidar`` for how depth and photos
are read.

Members of the archive are read one at a time and within limits.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path

import numpy as np

from bidnerf.formats import lidar
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    DepthFile,
    Format,
    Shot,
    camera_of,
    first_file,
    pose_of_numbers,
    warn_about,
)
from bidnerf_core.depth import DepthImage, depth_image
from bidnerf_core.errors import InputError
from bidnerf_core.installation import import_extra
from bidnerf_core.io import Archive, ImageSource, Record, is_file, parse_record, read_file

EXPECTED_RECORDING = "a Record3D recording (.r3d)"


def _read(path: Path, metadata_file: Path, options: DatasetOptions) -> Capture:
    """Read the metadata. Raises ``InputError`` if the metadata or the archive is damaged, and if ``lzfse`` is missing."""
    archive = None if path.is_dir() else Archive(path, EXPECTED_RECORDING)
    content = read_file(metadata_file, EXPECTED_RECORDING) if archive is None else archive.read("metadata")
    metadata = parse_record(str(metadata_file), content, "the metadata of Record3D")
    poses, width, height = metadata.items("poses") or [], metadata.size("w"), metadata.size("h")
    if not poses:
        raise metadata.error("no poses", expected="a list of qx qy qz qw tx ty tz; record with poses switched on")
    if width is None or height is None:
        raise metadata.error("no w and h", expected="the size of the photos")

    def file(*names: str) -> ImageSource:
        """Return the first of the files that exists, or else the path where the first one is expected."""
        packed = [archive.file(name) for name in names if name in archive] if archive is not None else []
        return next(iter(packed), first_file(path, *names) or path / names[0])

    frames = range(len(poses))
    depths = [file(f"rgbd/{number}.depth") for number in frames]
    if has_depth := any(map(_exists, depths)):
        import_extra("lzfse", "record3d", "reading depth of Record3D", path)
    elif (path / "depth").is_dir():
        warn_about(path / "depth", "depth in EXR files is not read; export the recording as .r3d to use its depth")
    stamps, fps = (metadata.items("frameTimestamps") or [])[: len(poses)], metadata.number("fps")
    times: list[float | None] = [number / fps if fps else None for number in frames]
    if len(stamps) == len(poses):
        times = [metadata.checked_number(stamp, "an entry of frameTimestamps") for stamp in stamps]
    cameras, read_depth = _cameras(metadata, len(poses)), lidar.LidarDepth()
    size, shots = (metadata.size("dw") or width, metadata.size("dh") or height), list[Shot]()
    for number, pose, depth in zip(frames, poses, depths, strict=True):
        where = f"{metadata.where}: pose {number}"
        if not isinstance(pose, list) or len(pose) != 7 or not all(type(x) in (int, float) for x in pose):
            raise InputError("is not 7 numbers", where=where, expected="qx qy qz qw tx ty tz")
        measured = partial(_depth, read_depth, depth, file(f"rgbd/{number}.conf"), size)
        shots.append(
            Shot(
                image=file(f"rgbd/{number}.jpg", f"rgb/{number}.jpg", f"rgb/{number}.png"),
                camera=camera_of(metadata.where, cameras[number], (width, height)),
                T_world_camera=pose_of_numbers(where, [*pose[4:], *pose[:4]], opengl=True),
                time=times[number],
                depth=DepthFile(depth if isinstance(depth, Path) else str(depth), measured) if has_depth else None,
                stem=str(number),
                folders=(),
                usual_side=lidar.LARGEST_SIDE,
            )
        )
    return Capture(
        path,
        shots,
        options.colour,
        unit="metres",
        pose_file=metadata.where,
        rate=lidar.FRAMES_PER_SECOND,
        poses_expected="finite qx qy qz qw tx ty tz of each frame",
    )


def _find(path: Path) -> Path | None:
    """Return the location of the metadata in the archive or folder."""
    if not path.is_dir():
        return path / "metadata" if path.suffix.lower() == ".r3d" else None
    if is_file(path / "metadata") and (path / "rgbd").is_dir():
        return path / "metadata"
    of_exr = path / "metadata.json"
    is_recording = is_file(of_exr) and (path / "rgb").is_dir() and b'"poses"' in read_file(of_exr, EXPECTED_RECORDING)
    return of_exr if is_recording else None


def _exists(file: ImageSource) -> bool:
    return not isinstance(file, Path) or is_file(file)


def _depth(read: lidar.LidarDepth, depth: ImageSource, confidence: ImageSource, size: tuple[int, int]) -> DepthImage:
    """Read the depth of a frame of ``size`` (width, height). Raises ``InputError`` if the number of bytes does not match."""
    measured = depth_image(_unpack(depth, "<f4", size), 1.0, f"{depth}: depth")
    sure = _unpack(confidence, "u1", size).astype(np.int64) if _exists(confidence) else None
    return read.sure(measured, sure, str(confidence))


def _unpack(file: ImageSource, kind: str, size: tuple[int, int]) -> np.ndarray:
    import lzfse

    packed = read_file(file, EXPECTED_RECORDING) if isinstance(file, Path) else file.read()
    try:
        content = lzfse.decompress(packed)
    except Exception as error:  # a C library raises it
        raise InputError(f"not readable as LZFSE ({error})", where=file, expected="a complete file") from error
    if len(content) != (count := np.dtype(kind).itemsize * math.prod(size)):
        raise InputError(
            f"unpacks to {len(content)} bytes", where=file, expected=f"{count} according to metadata (dw, dh)"
        )
    return np.frombuffer(content, kind).reshape(size[::-1])


def _cameras(metadata: Record, count: int) -> list[list[float]]:
    """Return fx, fy, cx and cy of each frame: per-frame values if recorded, else the same values for all."""
    rows, shared = metadata.items("perFrameIntrinsicCoeffs") or [], metadata.items("K") or []
    if len(rows) > count:
        raise metadata.error(f"perFrameIntrinsicCoeffs has {len(rows)} rows", expected=f"{count}, as poses")
    if len(rows) < count:
        rows = [[shared[i] for i in (0, 4, 6, 7)]] * count if len(shared) == 9 else []  # column by column
    if not rows or not all(isinstance(row, list) and len(row) >= 4 for row in rows):
        raise metadata.error(
            "no K with 9 numbers, and no perFrameIntrinsicCoeffs with 4 for each frame", expected="the intrinsics"
        )
    return [[metadata.checked_number(value, "an intrinsic") for value in row[:4]] for row in rows]


reader = Format(
    "Record3D: depth of confidence 2 up to 5 m (extra 'record3d')",
    "a .r3d file, or metadata with rgbd/0.jpg ..., or metadata.json with rgb/0.jpg ... (Record3D)",
    _find,
    _read,
    suffixes=(".r3d",),
    precedence=30,  # a recording with metric poses
)
