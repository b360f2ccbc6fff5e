"""Reconstructions of OpenSfM and OpenDroneMap (https://opensfm.org/docs/dataset.html): ``reconstruction.json``.

The file is a list of reconstructions, of which the one with the most images is used, with a remark. ``shots`` have the world-to-camera
pose (``rotation`` as an angle-axis vector, ``translation``; OpenCV axes), the name of their ``camera`` and the time in
``capture_time`` (seconds). Parameters of ``cameras`` refer to an image whose longer side is 1 and whose origin is its centre:
``focal`` (or ``focal_x``, ``focal_y``), ``c_x``, ``c_y``, and the distortion ``k1 k2 k3 p1 p2`` in OpenCV's convention. A pixel's
centre is at integer coordinates there, so the origin is half a pixel from the middle. Photos are in ``images``. Every eighth one (the
first, the ninth ...) is held out as "test" and the others are "train".
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.camera import Camera, CentralLens, Intrinsics, PanoramaFace
from bidnerf_core.datasets.capture import Capture, Shot, present, remark
from bidnerf_core.datasets.file_names import IMAGE_ENDINGS, FileNames, posix_name
from bidnerf_core.datasets.reader import DatasetOptions, Reader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Record, is_file, read_json

FILES = ("reconstruction.json", "opensfm/reconstruction.json")
IMAGES = ("images", "opensfm/images", ".", "../images")
PERSPECTIVE, FISHEYE = ("perspective", "brown", "simple_radial", "radial"), ("fisheye_opencv",)
LENS = ("k1", "k2", "p1", "p2", "k3")


class OpenSfMReader(Reader):
    """Reader for reconstructions of OpenSfM."""

    expected = "images with reconstruction.json (OpenSfM, OpenDroneMap)"

    def recognises(self, path: Path) -> bool:
        return _file(path) is not None

    def read(self, path: Path, options: DatasetOptions) -> Capture:
        """Read the reconstruction. Raises ``InputError`` if it is invalid, and if no photo is found."""
        file = _file(path)
        assert file is not None  # ensured by recognises
        found = read_json(file, "a reconstruction of OpenSfM")
        parts = [part for part in found if isinstance(part, dict)] if isinstance(found, list) else []
        parts = [part for part in parts if isinstance(part.get("shots"), dict) and part["shots"]]
        if not parts:
            expected = "a list of reconstructions with shots and cameras"
            raise InputError("has no shots", where=file, expected=expected)
        part = max(parts, key=lambda part: len(part["shots"]))
        shots: dict[str, Any] = part["shots"]
        cameras = part.get("cameras")
        if len(parts) > 1:
            remark(
                file, f"has {len(parts)} reconstructions, of which the one with {len(shots)} images is used"
            )
        places = [FileNames(path / place) for place in IMAGES if (path / place).is_dir()]
        files = {
            name: image
            for name in shots
            if (image := next((i for p in places if (i := p.find(posix_name(name), IMAGE_ENDINGS))), None))
            is not None
        }
        names = present(
            sorted(shots, key=natural_order),
            files.__contains__,
            file,
            str,
            lambda name: InputError(f"no image {name}", where=file, expected="it in images"),
        )
        return Capture(
            path,
            [_shot(file, name, shots[name], cameras, files[name]) for name in names],
            options.colour,
            pose_file=file,
        )


def _file(path: Path) -> Path | None:
    return next((file for name in FILES if is_file(file := path / name)), None)


def _shot(file: Path, name: str, entry: Any, cameras: Any, image: Path) -> Shot:
    where = f"{file}: {name}"
    record = Record(where, entry if isinstance(entry, dict) else {})
    own = cameras.get(str(record.value("camera"))) if isinstance(cameras, dict) else None
    if not isinstance(own, dict):
        raise record.error(f"has the camera {record.value('camera')!r}", expected="one of cameras")
    numbers = [
        [record.checked_number(n, key) for n in record.items(key) or []]
        for key in ("rotation", "translation")
    ]
    if [len(found) for found in numbers] != [3, 3]:
        raise record.error("has no pose", expected="rotation and translation of 3 numbers each")
    turn = torch.from_numpy(Rotation.from_rotvec(numbers[0]).as_matrix())
    T_camera_world = SE3(turn, torch.tensor(numbers[1], dtype=torch.float64))
    time = record.number("capture_time") or None  # 0 where a photo does not record it
    return Shot(
        image=image,
        camera=_camera(Record(f"{where}: camera", own)),
        T_world_camera=T_camera_world.inverse(),
        time=time,
    )


def _camera(record: Record) -> Camera:
    width, height, kind = (
        record.size("width"),
        record.size("height"),
        record.text("projection_type") or "perspective",
    )
    if width is None or height is None:
        raise record.error("no width and height", expected="the size of its images")
    if kind in ("spherical", "equirectangular"):
        return PanoramaFace("front", (width, height))
    if kind not in (*PERSPECTIVE, *FISHEYE):
        raise record.error(
            f"projection_type is {kind}", expected=f"one of {', '.join((*PERSPECTIVE, *FISHEYE))}"
        )
    side, focal = max(width, height), record.number("focal")
    fx, fy = (record.number(key) or focal for key in ("focal_x", "focal_y"))
    if fx is None or fy is None:
        raise record.error("no focal", expected="the focal length, relative to the longer side")
    cx, cy = (
        (record.number(key) or 0.0) * side + size / 2 for key, size in (("c_x", width), ("c_y", height))
    )
    k1, k2, p1, p2, k3 = (record.number(key) or 0.0 for key in LENS)
    try:
        if kind in FISHEYE:
            flat = Intrinsics(fx * side, fy * side, cx, cy, width, height)
            return CentralLens("OPENCV_FISHEYE", flat, (k1, k2, k3, record.number("k4") or 0.0))
        lens = (k1, k2, p1, p2, k3) if any((k1, k2, p1, p2, k3)) else ()
        return Intrinsics(fx * side, fy * side, cx, cy, width, height, lens)
    except InputError as error:
        raise record.error(error) from error


reader = OpenSfMReader()
