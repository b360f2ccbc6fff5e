"""Photos whose cameras were exported by Agisoft Metashape (File > Export > Export Cameras, "Agisoft XML").

A ``camera`` has the camera-to-chunk matrix ``transform`` (4x4, row by row; OpenCV axes), the photo's name
in ``label``, and the ``sensor`` that took it: ``resolution`` and the adjusted ``calibration`` with ``f``
(pixels), ``cx cy`` (from the image centre) and the distortion ``k1 k2 k3 p1 p2``, whose p1 and p2 are
OpenCV's p2 and p1. If the chunk is georeferenced or has scale bars, its ``scale`` converts positions to
metres; its rotation and translation are not applied, so the world is the chunk. The transforms of its ``components`` are. A
camera with a ``master_id`` has the pose of that camera, moved by the ``rotation`` and ``location`` of its sensor. Photos are in
the folder or in ``images``.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element

from bidnerf.formats.reality_capture import file_heads
from bidnerf_core.camera import Camera, agisoft_camera
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    FileNames,
    Format,
    Shot,
    numbers_in,
    pixel_size,
    pose_of_matrix,
    warn_about,
)
from bidnerf_core.errors import InputError, amount
from bidnerf_core.geometry import SE3, Similarity
from bidnerf_core.io import parse_xml, read_file


def _read(path: Path, file: Path, options: DatasetOptions) -> Capture:
    """Read the cameras. Raises ``InputError`` if one is invalid."""
    expected = "cameras exported by Metashape"
    chunks = parse_xml(read_file(file, expected), str(file), expected).findall("chunk")
    if not chunks:
        raise InputError("has no chunk", where=file, expected=expected)
    chunk, *others = sorted(chunks, key=lambda chunk: -len(chunk.findall(".//camera")))
    if any(other.find(".//camera") is not None for other in others):
        count = len(chunk.findall(".//camera"))
        warn_about(
            file, f"has {len(chunks)} chunks, of which the one with {count} cameras is used; export the others alone"
        )
    sensors = {sensor.get("id"): sensor for sensor in chunk.iter("sensor")}
    lenses = {key: _camera(sensor, f"{file}: sensor {key}") for key, sensor in sensors.items()}
    metric = chunk.find("transform/scale")
    scale = 1.0 if metric is None else _scale(f"{file}: the scale of the chunk", metric)
    listed, frames = list(chunk.iter("camera")), _components(file, chunk)
    masters, labels = {camera.get("id"): camera for camera in listed}, {camera.get("label") for camera in listed}
    if len(labels) < len(listed):
        raise InputError("two cameras have the same label", where=file, expected="unique labels of photos")

    def master_of(camera: Element) -> Element:
        """Return the camera whose pose and component those of a rig have, their sensors having poses in its frame."""
        return masters.get(camera.get("master_id"), camera)

    def read(image: Path, label: str, camera: Element) -> Shot:
        where, lens, master = f"{file}: camera {label}", lenses.get(camera.get("sensor_id")), master_of(camera)
        if lens is None:
            raise InputError("has no calibrated sensor", where=where, expected="the id of one")
        transform, pose = master.find("transform"), None
        if transform is not None:
            pose = pose_of_matrix(where, numbers_in(where, transform.text or "", 16))
            if master is not camera:
                pose = pose @ _pose(where, sensors[camera.get("sensor_id")], "location")
            component = frames[master.get("component_id")]
            assert component is not None  # the others are not listed below
            pose = Similarity(scale, SE3.identity()).move(component.move(pose))
        return Shot(image=image, camera=lens, T_world_camera=pose)

    names = FileNames(path, *(path / place for place in ("images", "photos", "input")), images=options.image_folder)
    cameras = {c.get("label") or "": c for c in listed if frames.get(master_of(c).get("component_id"), "none")}
    return Capture(
        path,
        names.shots(cameras, read),
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


def _components(file: Path, chunk: Element) -> dict[str | None, Similarity | None]:
    """Return the frames in the chunk of the components with posed cameras, by their ids; None for those that are not used.

    Components whose transform is complete are connected; each of the others has a frame of its own. The connected ones, or
    one other, are used, whichever has more images; a remark says how many images these are.
    """
    posed = Counter(
        camera.get("component_id") for camera in chunk.iter("camera") if camera.find("transform") is not None
    )
    connected = dict[str | None, Similarity]()
    for component in chunk.findall("components/component"):
        transform, where = component.find("transform"), f"{file}: component {component.get('id')}"
        if transform is not None and transform.find("translation") is not None:
            element = transform.find("scale")
            scale = 1.0 if element is None else _scale(f"{where}: its scale", element)
            connected[component.get("id")] = Similarity(scale, _pose(where, transform, "translation"))
    alone = [{key: Similarity(1.0, SE3.identity())} for key in posed if key not in connected]
    used = max([connected, *alone], key=lambda frames: sum(posed[key] for key in frames))
    count = sum(posed[key] for key in used)
    if count < posed.total():
        warn_about(file, f"its components are not connected; the largest is used, with {amount(count, 'image')}")
    return dict[str | None, Similarity | None].fromkeys(posed) | used


def _pose(where: str, element: Element, position: str) -> SE3:
    """Return a pose from its ``rotation`` (row by row) and the ``position``."""
    turn = numbers_in(f"{where}: rotation", element.findtext("rotation") or "1 0 0 0 1 0 0 0 1", 9)
    x = numbers_in(f"{where}: {position}", element.findtext(position) or "0 0 0", 3)
    return pose_of_matrix(where, [*turn[:3], x[0], *turn[3:6], x[1], *turn[6:], x[2]])


def _scale(where: str, element: Element) -> float:
    (scale,) = numbers_in(where, element.text or "", 1)
    if not 0 < scale < 1e10:
        raise InputError(f"is {scale:g}", where=where, expected="a positive number")
    return scale


def _camera(sensor: Element, where: str) -> Camera | None:
    """Return the camera of a sensor; None if it is not calibrated."""
    size, found = sensor.find("resolution"), sensor.findall("calibration")
    adjusted = [each for each in found if each.get("class") in ("adjusted", None)][-1:] or found[:1]
    if size is None:
        return None
    sides = numbers_in(f"{where}: its resolution", f"{size.get('width') or ''} {size.get('height') or ''}", 2)
    kind = sensor.get("type") or "frame"
    if not adjusted and kind != "spherical":
        return None
    return agisoft_camera(where, kind, pixel_size(where, sides), adjusted[0] if adjusted else sensor)


reader = Format(
    "cameras exported by Agisoft Metashape ('Agisoft XML'), without depth",
    "photos with a .xml of a chunk's cameras (Agisoft Metashape)",
    _find,
    _read,
    ["images"],
    precedence=10,  # its file has no name of its own, so formats with one come first
)
