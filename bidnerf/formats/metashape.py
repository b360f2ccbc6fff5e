"""Photos whose cameras were exported by Agisoft Metashape (File > Export > Export Cameras, "Agisoft XML").

A ``camera`` has the camera-to-chunk matrix ``transform`` (4x4, row by row; OpenCV axes), the photo's name
in ``label``, and the ``sensor`` that took it: ``resolution`` and the adjusted ``calibration`` with ``f``
(pixels), ``cx cy`` (from the image centre) and the distortion ``k1 k2 k3 p1 p2``, whose p1 and p2 are
OpenCV's p2 and p1. If the chunk is georeferenced or has scale bars, its ``scale`` converts positions to
metres; its rotation and translation are not applied, so the world is the chunk. Photos are in the folder or in
``images``.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from bidnerf.formats.reality_capture import file_heads
from bidnerf_core.camera import Camera, PanoramaFace, colmap_camera
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    FileNames,
    Format,
    Shot,
    camera_of,
    numbers_in,
    pixel_size,
    pose_of_matrix,
)
from bidnerf_core.errors import InputError
from bidnerf_core.frames import natural_order
from bidnerf_core.geometry import SE3
from bidnerf_core.io import is_file, parse_xml, read_file


def _read(path: Path, file: Path, options: DatasetOptions) -> Capture:
    """Read the cameras. Raises ``InputError`` if one is invalid."""
    chunk = _chunk(file)
    sensors = {
        sensor.get("id"): _camera(sensor, f"{file}: sensor {sensor.get('id')}") for sensor in chunk.iter("sensor")
    }
    metric = chunk.find("transform/scale")
    scale = 1.0 if metric is None else numbers_in(f"{file}: the scale of the chunk", metric.text or "", 1)[0]
    names = FileNames(path, *(path / place for place in ("images", "photos", "input")), images=options.image_folder)
    listed = list(chunk.iter("camera"))
    cameras = {camera.get("label") or "": camera for camera in listed}
    if len(cameras) < len(listed):
        raise InputError("two cameras have the same label", where=file, expected="unique labels of photos")
    shots = list[Shot]()
    for label in sorted(cameras, key=natural_order):
        transform, sensor = cameras[label].find("transform"), sensors.get(cameras[label].get("sensor_id"))
        where, pose, image = f"{file}: camera {label}", None, names.image(label)
        if not is_file(image):  # its sensor may never have been calibrated
            shots.append(Shot(image=image))
            continue
        if sensor is None:
            raise InputError("has no calibrated sensor", where=where, expected="the id of one")
        if transform is not None:
            pose = pose_of_matrix(where, numbers_in(where, transform.text or "", 16))
            pose = SE3(pose.rotation, pose.translation * scale)
        shots.append(Shot(image=image, camera=sensor, T_world_camera=pose))
    return Capture(
        path,
        shots,
        options.colour,
        unit=None if metric is None else "metres",
        pose_file=file,
        poses_expected="a transform of each aligned camera",
        unposed="they are not aligned",
    )


def _find(path: Path) -> Path | None:
    """Return the first XML file in whose first bytes the root and a chunk begin."""
    heads = file_heads(path, "[!.]*.xml", "cameras of Metashape")
    return next((file for file, head in heads if b"<document" in head and b"<chunk" in head), None)


def _chunk(file: Path) -> ElementTree.Element:
    """Return the first chunk. Raises ``InputError`` for invalid XML, and for XML entities, whose expansion may be unbounded."""
    expected = "cameras exported by Metashape"
    chunk = parse_xml(read_file(file, expected), str(file), expected).find("chunk")
    if chunk is None:
        raise InputError("has no chunk", where=file, expected=expected)
    return chunk


def _camera(sensor: ElementTree.Element, where: str) -> Camera | None:
    """Return the camera of a sensor; None if it is not calibrated."""
    size, found = sensor.find("resolution"), sensor.findall("calibration")
    adjusted = [each for each in found if each.get("class") in ("adjusted", None)][-1:] or found[:1]
    if size is None:
        return None
    sides = " ".join(size.get(side) or "" for side in ("width", "height"))
    width, height = pixel_size(where, numbers_in(f"{where}: its resolution", sides, 2))
    if sensor.get("type") == "spherical":
        return PanoramaFace("front", (width, height))
    if not adjusted:
        return None
    values = {
        child.tag: numbers_in(where, child.text or "", 1)[0]
        for child in adjusted[0]
        if child.tag not in ("resolution", "covariance", "params")
    }
    f, cx, cy, k1, k2, k3, k4, p1, p2, b1 = (
        values.get(key, 0.0) for key in ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "b1")
    )
    numbers = f + b1, f, width / 2 + cx, height / 2 + cy
    if sensor.get("type") == "fisheye":
        return colmap_camera(where, "OPENCV_FISHEYE", width, height, [*numbers, k1, k2, k3, k4])
    return camera_of(where, numbers, (width, height), (k1, k2, p2, p1, k3), first_centre=0)


reader = Format(
    "cameras exported by Agisoft Metashape ('Agisoft XML'), without depth",
    "photos with a .xml of a chunk's cameras (Agisoft Metashape)",
    _find,
    _read,
    ["images"],
    precedence=10,  # its file has no name of its own, so formats with one come first
)
