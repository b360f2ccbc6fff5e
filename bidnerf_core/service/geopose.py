"""The GeoPose Protocol of the Open AR Cloud, version 2: a request with a camera reading, and the answer with a geopose.

https://github.com/OpenArCloud/oscp-geopose-protocol. The quaternion rotates from the camera to east, north
and up at the camera; as in OGC GeoPose 1.0, where a pose without rotation looks east with its left side
north, the camera's axes are x forward, y left and z up. ``accuracy`` is derived from the covariances of the
pose and the anchor.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import MODELS
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3, Geodetic
from bidnerf_core.io import Record, png_bytes
from bidnerf_core.localization import Localization
from bidnerf_core.maps import Anchor, GeographicPose
from bidnerf_core.results import Answer
from bidnerf_core.service.requests import LONGEST_NAME
from bidnerf_core.service.upload import Upload

R_CAMERA_BODY = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
"""Rotation from body axes (x forward, y left, z up) to OpenCV's camera axes."""
RAW_CHANNELS = {"RGBA32": 4, "RGB24": 3, "GRAY8": 1}
"""Formats without a header, and their bytes per pixel."""
NOT_LOCALIZED = 422


@dataclass(frozen=True)
class _Reading:
    """A camera reading."""

    record: Record
    image: bytes
    size: tuple[int, int] | None  # width and height


def answer(
    anchor: Anchor | None, body: dict[str, Any], localize: Callable[[Upload], tuple[Answer, dict[str, Any]]]
) -> dict[str, Any]:
    """Return the status and body of the response to a request of the protocol.

    A map without an anchor responds with a ``localpose`` instead of a ``geopose``: position and quaternion in
    the map's frame. A pose that was not accepted is never returned. Raises ``InputError`` for an invalid
    request.
    """
    request = Record("request", body)
    _check_unused(request)
    reading = _reading(request)
    blocks = {"photo": reading.image} | _camera(reading) | _prior(anchor, request)
    name = (reading.record.text("sensorId") or "camera")[:LONGEST_NAME]
    found, plain = localize(Upload({"name": name}, blocks))
    localization = found.found
    if not found.accepted:
        return {
            "status": NOT_LOCALIZED, "outcome": plain["outcome"], "extra": {"localization": plain},
            "detail": f"not localized: {localization.outcome}: {localization.reason}",
        }  # fmt: skip
    where = (
        _local(localization)
        if anchor is None
        else _geographic(anchor.geographic(localization.T_world_camera))
    )
    answered = {
        "id": (request.text("id") or "")[:LONGEST_NAME], "timestamp": round(time.time() * 1000),
        "accuracy": accuracy(localization, anchor), "type": "geopose" if anchor else "localpose", **where,
        "localization": plain,
    }  # fmt: skip
    return {"status": 200, "body": answered, "outcome": plain["outcome"]}


def _check_unused(request: Record) -> None:
    """Raise ``InputError`` for values of another type than the protocol says, of keys that change nothing here."""
    request.number("timestamp")
    request.text("type")
    for sensor in _records(request, "sensors"):
        sensor.text("id")
        sensor.text("type")


def accuracy(found: Localization, anchor: Anchor | None) -> dict[str, float] | None:
    """Return standard deviations: metres along an axis, degrees about one, each the root mean square of the
    three axes.

    None if the covariance is unknown, since any number would be wrong. Without an anchor, metres are units of
    the map.
    """
    if found.covariance is None or not bool(found.covariance.isfinite().all()):
        return None
    position, orientation = (
        float(part.mean().clamp(min=0).sqrt()) for part in found.covariance.diagonal().split(3)
    )
    orientation = math.degrees(orientation)
    if anchor is None:
        return {"position": position, "orientation": orientation}
    return {
        "position": math.hypot(position * anchor.metres_per_unit, anchor.position_sigma),
        "orientation": math.hypot(orientation, anchor.orientation_sigma),
    }


def _geographic(pose: GeographicPose) -> dict[str, Any]:
    place = pose.place
    position = {"lon": place.longitude, "lat": place.latitude, "h": place.height}
    return {"geopose": {"position": position, "quaternion": _quaternion(pose.rotation)}}


def _local(found: Localization) -> dict[str, Any]:
    pose = found.T_world_camera.to("cpu", torch.float64)
    position = dict(zip("xyz", pose.translation.tolist(), strict=True))
    return {"localpose": {"position": position, "quaternion": _quaternion(pose.rotation)}}


def _quaternion(R_frame_camera: Float[Tensor, "3 3"]) -> dict[str, float]:
    """Return the unit quaternion that rotates from body axes (x forward, y left, z up) to the frame, with w >= 0."""
    R_frame_body = R_frame_camera.double() @ R_CAMERA_BODY
    numbers = SE3(R_frame_body, R_frame_body.new_zeros(3)).quaternion("xyzw").tolist()
    return dict(zip("xyzw", numbers, strict=True))


def _reading(request: Record) -> _Reading:
    """Return the single image of a request."""
    records = _records(_object(request, "sensorReadings"), "cameraReadings")
    if len(records) != 1:
        raise InputError(f"{len(records)} cameraReadings", where="request", expected="one")
    (record,) = records
    orientation = _object(record, "imageOrientation")
    if orientation.value("mirrored") or orientation.number("rotation"):
        raise record.error(
            "imageOrientation does not match the image", expected="an upright image that is not mirrored"
        )
    text = record.text("imageBytes")
    if not text:
        raise record.error("no imageBytes", expected="a base64 image")
    try:
        content = base64.b64decode(
            text.partition("base64,")[2] if text.startswith("data:") else text, validate=True
        )
    except (binascii.Error, ValueError) as error:
        raise record.error(f"imageBytes is not base64 ({error})") from error
    size = _size(record)
    return _Reading(record, _encoded(record, content, size), size)


def _object(record: Record, key: str) -> Record:
    """Return an object inside another one; an empty one if it is missing."""
    found = record.value(key)
    if found is not None and not isinstance(found, dict):
        raise record.error(f"{key} is a {type(found).__name__}", expected="an object")
    return Record(f"{record.where}: {key}", found or {})


def _records(record: Record, key: str) -> list[Record]:
    """Return the objects in a list; none if it is missing."""
    items = record.items(key) or []
    if not all(isinstance(item, dict) for item in items):
        raise record.error(f"{key} holds something other than objects")
    return [Record(key, item) for item in items]


def _numbers(record: Record, key: str) -> list[float]:
    return [record.checked_number(value, key) for value in record.items(key) or []]


def _size(record: Record) -> tuple[int, int] | None:
    if record.value("size") is None:
        return None
    size = _numbers(record, "size")
    if len(size) != 2 or not all(1 <= value <= 1e6 and value == int(value) for value in size):
        raise record.error("size:", expected="width and height")
    return int(size[0]), int(size[1])


def _encoded(record: Record, content: bytes, size: tuple[int, int] | None) -> bytes:
    """Return an image file: ``content`` itself, or raw pixels as PNG."""
    kind = (record.text("imageFormat") or "").upper()
    if kind == "DEPTH":
        raise record.error("imageFormat is DEPTH", expected="a colour image; /localize accepts depth as well")
    if kind not in RAW_CHANNELS:
        return content
    channels = RAW_CHANNELS[kind]
    if size is None or len(content) != size[0] * size[1] * channels:
        if content[:2] == b"\xff\xd8" or content[:4] == b"\x89PNG":
            return content  # the pixel format within a file
        raise record.error(
            f"{len(content)} bytes of {kind}", expected=f"size and width x height x {channels} bytes"
        )
    pixels = np.frombuffer(content, np.uint8).reshape(size[1], size[0], channels)
    return png_bytes(pixels[..., :3] if channels > 1 else pixels[..., 0])


def _camera(reading: _Reading) -> dict[str, bytes]:
    """Return the camera as a line of COLMAP's ``cameras.txt``, whose models the protocol uses."""
    params = _object(reading.record, "params")
    model, numbers = params.text("model") or "UNKNOWN_CAMERA", _numbers(params, "modelParams")
    if model == "UNKNOWN_CAMERA" or not numbers:
        return {}
    if model not in MODELS:
        raise params.error(f"model is {model!r}", expected=f"one of {', '.join(MODELS)}")
    if reading.size is None:
        raise reading.record.error(
            "a camera model without a size", expected="the width and height of its image"
        )
    width, height = reading.size
    return {"camera": f"1 {model} {width} {height} {' '.join(map(repr, numbers))}\n".encode()}


def _prior(anchor: Anchor | None, request: Record) -> dict[str, bytes]:
    """Return the last of the prior poses as a start. Without an anchor, geoposes cannot be related to the map."""
    priors = [_geographic_prior(prior) for prior in _records(request, "priorPoses")]
    return {"start": _matrix(anchor.T_world_camera(priors[-1]))} if anchor is not None and priors else {}


def _geographic_prior(prior: Record) -> GeographicPose:
    pose = _object(prior, "geopose")
    position, quaternion = _object(pose, "position"), _object(pose, "quaternion")
    lat, lon, h = (_required(position, key) for key in ("lat", "lon", "h"))
    q = torch.tensor([_required(quaternion, key) for key in "xyzw"], dtype=torch.float64)
    length = float(torch.linalg.vector_norm(q))
    if not 0.9 < length < 1.1:
        raise quaternion.error(f"has length {length:.3g}", expected="1")
    rotation = SE3.from_quaternion(q, q.new_zeros(3), "xyzw").rotation @ R_CAMERA_BODY.mT
    return GeographicPose(Geodetic(lat, lon, h), rotation)


def _required(record: Record, key: str) -> float:
    found = record.number(key)
    if found is None:
        raise record.error(f"no {key!r}", expected="a number")
    return found


def _matrix(pose: SE3) -> bytes:
    rows: Mapping[str, Any] = {"T_world_camera": pose.matrix().tolist()}
    return json.dumps(rows).encode()
