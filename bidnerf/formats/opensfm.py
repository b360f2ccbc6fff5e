"""Reconstructions of OpenSfM and OpenDroneMap (https://opensfm.org/docs/dataset.html): ``reconstruction.json``.

The file is a list of reconstructions, of which the one with the most images is used, with a remark.
``shots`` have the world-to-camera pose (``rotation`` as an angle-axis vector, ``translation``; OpenCV
axes), the name of their ``camera`` and the time in ``capture_time`` (seconds). Parameters of ``cameras``
refer to an image whose longer side is 1 and whose origin is its centre: ``focal`` (or ``focal_x``,
``focal_y``), ``c_x``, ``c_y``, and the distortion ``k1 k2 k3 p1 p2`` in OpenCV's convention. Pixel
centres are at integer coordinates there, and the origin is at ((width - 1) / 2, (height - 1) / 2), the image
centre in our convention too. Photos are in ``images``.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.camera import Camera, camera_of_record
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    FileNames,
    Format,
    Shot,
    first_file,
    warn_about,
)
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Record, read_json

PROJECTIONS = dict.fromkeys(("perspective", "brown", "simple_radial", "radial"), "OPENCV") | {
    "fisheye_opencv": "OPENCV_FISHEYE",
    "spherical": "EQUIRECTANGULAR",
    "equirectangular": "EQUIRECTANGULAR",
}
"""The projection types that are read, and COLMAP's models of the same lenses."""


def _read(path: Path, file: Path, options: DatasetOptions) -> Capture:
    """Read the reconstruction. Raises ``InputError`` if it is invalid."""
    found = read_json(file, "a reconstruction of OpenSfM")
    parts = [part for part in (found if isinstance(found, list) else []) if isinstance(part, dict)]
    parts = [part for part in parts if isinstance(part.get("shots"), dict) and part["shots"]]
    if not parts:
        raise InputError("has no shots", where=file, expected="a list of reconstructions with shots and cameras")
    part = max(parts, key=lambda part: len(part["shots"]))
    entries, cameras, known = part["shots"], part.get("cameras"), dict[str, Camera]()
    if len(parts) > 1:
        warn_about(file, f"has {len(parts)} reconstructions, of which the one with {len(entries)} images is used")

    def read(image: Path, name: str, entry: Any) -> Shot:
        record = Record(f"{file}: {name}", entry if isinstance(entry, dict) else {})
        key = str(record.value("camera"))
        own = cameras.get(key) if isinstance(cameras, dict) else None
        if not isinstance(own, dict):
            raise record.error(f"has the camera {key[:60]!r}", expected="one of cameras")
        if key not in known:
            known[key] = _camera(Record(f"{record.where}: camera", own))
        turn, position = (
            [record.checked_number(n, k) for n in record.items(k) or []] for k in ("rotation", "translation")
        )
        if not len(turn) == len(position) == 3:
            raise record.error("has no pose", expected="rotation and translation of 3 numbers each")
        rotation = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix())
        T_world_camera = SE3(rotation, torch.tensor(position, dtype=torch.float64)).inverse()
        # The time is 0 where a photo does not record it.
        return Shot(
            image=image, camera=known[key], T_world_camera=T_world_camera, time=record.number("capture_time") or None
        )

    others = (".", "images", "opensfm/images", "../images")
    names = FileNames(*(path / place for place in others), images=options.image_folder)
    return Capture(path, names.shots(entries, read), options.colour, pose_file=file)


def _camera(record: Record) -> Camera:
    """Return the camera, whose numbers are relative to the longer side and to the centre of the image."""
    width, height = record.size("width"), record.size("height")
    kind = record.text("projection_type") or "perspective"
    if width is None or height is None:
        raise record.error("no width and height", expected="the size of its images")
    if kind not in PROJECTIONS:
        raise record.error(f"projection_type is {kind}", expected=f"one of {', '.join(PROJECTIONS)}")
    side, focal = max(width, height), record.number("focal")
    fx, fy = (record.number(key) or focal for key in ("focal_x", "focal_y"))
    if PROJECTIONS[kind] != "EQUIRECTANGULAR" and (fx is None or fy is None):
        raise record.error("no focal", expected="the focal length, relative to the longer side")
    centre = {"cx": ("c_x", width), "cy": ("c_y", height)}
    values: dict[str, Any] = {name: (record.number(key) or 0.0) * side + s / 2 for name, (key, s) in centre.items()}
    values |= {key: record.number(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
    values |= {"camera_model": PROJECTIONS[kind], "fl_x": (fx or 0) * side, "fl_y": (fy or 0) * side}
    return camera_of_record(Record(record.where, values), (width, height))


reader = Format(
    "OpenSfM and OpenDroneMap: the largest reconstruction, with times, without depth",
    "images with reconstruction.json (OpenSfM, OpenDroneMap)",
    lambda path: first_file(path, "reconstruction.json", "opensfm/reconstruction.json"),
    _read,
    ["images"],
    precedence=13,  # after LLFF, which is made from COLMAP's reconstruction
)
