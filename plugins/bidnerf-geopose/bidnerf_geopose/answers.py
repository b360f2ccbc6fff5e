"""Answers of the GeoPose Protocol.

The quaternion rotates from the camera to east, north and up at the camera; as in OGC GeoPose 1.0, where a pose without
rotation looks east with its left side north, the camera's axes are x forward, y left and z up. ``accuracy`` is derived
from the covariances of the pose and the anchor.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.results import Answer
from bidnerf.service import LONGEST_NAME, Refused, Upload
from bidnerf_core.camera import MODELS
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import png_bytes
from bidnerf_core.localization import Localization
from bidnerf_core.maps import Anchor
from bidnerf_geopose.earth import GeographicPose
from bidnerf_geopose.protocol import GeoPose, GeoPoseRequest, Reading
from bidnerf_geopose.wgs84 import Geodetic

R_CAMERA_BODY = torch.tensor([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
"""Rotation from body axes (x forward, y left, z up) to OpenCV's camera axes."""
RAW_CHANNELS = {"RGBA32": 4, "RGB24": 3, "GRAY8": 1}
"""Formats without a header, and their bytes per pixel."""


def answer(
    anchor: Anchor | None,
    request: GeoPoseRequest,
    localize: Callable[[Upload], tuple[Answer, dict[str, Any]]],
) -> dict[str, Any]:
    """Return the JSON of the answer to a request of the protocol.

    A map without an anchor responds with a ``localpose`` instead of a ``geopose``: position and quaternion in
    the map's frame. Raises ``InputError`` for an invalid request, and ``Refused`` for a pose that was not accepted.
    """
    (reading,) = request.sensorReadings.cameraReadings
    parameters = {"name": (reading.sensorId or "camera")[:LONGEST_NAME], **_camera(reading)}
    if anchor is not None and request.priorPoses:
        start = _geographic_pose(request.priorPoses[-1].geopose).in_map(anchor)
        parameters["start"] = json.dumps({"T_world_camera": start.matrix().tolist()})
    answer, plain = localize(Upload(parameters, {"photo": _image(reading)}))
    localization = answer.localization
    if not answer.accepted:
        reason = f"not localized: {localization.outcome}: {localization.reason}"
        raise Refused(422, reason, localization=plain)
    return {
        "id": request.id[:LONGEST_NAME],
        "timestamp": round(time.time() * 1000),
        "accuracy": accuracy(localization, anchor),
        **_pose(localization.T_world_camera, anchor),
        "localization": plain,
    }


def _pose(T_world_camera: SE3, anchor: Anchor | None) -> dict[str, Any]:
    if anchor is None:
        pose = T_world_camera.to("cpu", torch.float64)
        position = dict(zip("xyz", pose.translation.tolist(), strict=True))
        local = {"position": position, "quaternion": _quaternion(pose.rotation)}
        return {"type": "localpose", "localpose": local}
    geographic = GeographicPose.of(T_world_camera, anchor)
    place = geographic.place
    position = {"lon": place.longitude, "lat": place.latitude, "h": place.height}
    return {
        "type": "geopose",
        "geopose": {"position": position, "quaternion": _quaternion(geographic.rotation)},
    }


def accuracy(found: Localization, anchor: Anchor | None) -> dict[str, float] | None:
    """Return standard deviations: metres along an axis, degrees about one, each the root mean square of the
    three axes.

    None if the covariance is unknown, since any number would be wrong. Without an anchor, metres are units of
    the map.
    """
    if found.covariance is None or not bool(found.covariance.isfinite().all()):
        return None
    position, orientation = (float(part.mean().clamp(min=0).sqrt()) for part in found.covariance.diagonal().split(3))
    orientation = math.degrees(orientation)
    if anchor is None:
        return {"position": position, "orientation": orientation}
    return {
        "position": math.hypot(position * anchor.metres_per_unit, anchor.position_sigma),
        "orientation": math.hypot(orientation, anchor.orientation_sigma),
    }


def _quaternion(R_frame_camera: Float[Tensor, "3 3"]) -> dict[str, float]:
    """Return the unit quaternion that rotates from body axes (x forward, y left, z up) to the frame, with w >= 0."""
    R_frame_body = R_frame_camera.double() @ R_CAMERA_BODY
    numbers = SE3(R_frame_body, R_frame_body.new_zeros(3)).quaternion("xyzw").tolist()
    return dict(zip("xyzw", numbers, strict=True))


def _geographic_pose(pose: GeoPose) -> GeographicPose:
    place, quaternion = pose.position, pose.quaternion
    q = torch.tensor([quaternion.x, quaternion.y, quaternion.z, quaternion.w], dtype=torch.float64)
    rotation = SE3.from_quaternion(q, q.new_zeros(3), "xyzw").rotation @ R_CAMERA_BODY.mT
    return GeographicPose(Geodetic(place.lat, place.lon, place.h), rotation)


def _image(reading: Reading) -> bytes:
    """Return the image file of a reading; raw pixels become a PNG."""
    if reading.imageOrientation.mirrored or reading.imageOrientation.rotation:
        expected = "an upright image that is not mirrored"
        raise InputError("imageOrientation does not match the image", expected=expected)
    text, kind = reading.imageBytes, reading.imageFormat.upper()
    try:
        encoded = text.partition("base64,")[2] if text.startswith("data:") else text
        content = base64.b64decode(encoded, validate=True)
    except (binascii.Error, ValueError) as error:
        raise InputError(f"imageBytes is not base64 ({error})") from error
    if kind == "DEPTH":
        raise InputError("imageFormat is DEPTH", expected="a colour image; /localize accepts depth as well")
    if kind not in RAW_CHANNELS or content[:2] == b"\xff\xd8" or content[:4] == b"\x89PNG":
        return content  # a file, whose pixel format it may be
    width, height = reading.size or (0, 0)
    channels = RAW_CHANNELS[kind]
    if not content or len(content) != width * height * channels:
        raise InputError(f"{len(content)} bytes of {kind}", expected=f"size and width x height x {channels} bytes")
    pixels = np.frombuffer(content, np.uint8).reshape(height, width, channels)
    return png_bytes(pixels[..., :3] if channels > 1 else pixels[..., 0])


def _camera(reading: Reading) -> dict[str, str]:
    """Return the camera as a row of COLMAP's ``cameras.txt``, whose models the protocol uses."""
    model, numbers = reading.params.model, reading.params.modelParams
    if model == "UNKNOWN_CAMERA" or not numbers:
        return {}
    if model not in MODELS:
        raise InputError(f"model is {model!r}", expected=f"one of {', '.join(MODELS)}")
    if not reading.size:
        raise InputError("a camera model without a size", expected="the width and height of its image")
    width, height = reading.size
    return {"camera": f"1 {model} {width} {height} {' '.join(map(repr, numbers))}\n"}
