"""Answers of the GeoPose Protocol, and the paths of a service that has the plugin."""

from __future__ import annotations

import base64
import io
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from bidnerf import SE3, InputError, Intrinsics, Localization, Outcome
from bidnerf.results import Answer
from bidnerf.service import Refused, service_app, validate
from bidnerf_core.maps import Anchor
from bidnerf_core.registry import registered
from bidnerf_geopose import answers
from bidnerf_geopose.earth import GeographicPose
from bidnerf_geopose.protocol import GEOPOSE, GeoPoseRequest
from bidnerf_geopose.wgs84 import Geodetic

TURNED = SE3.exp(torch.tensor([3.0, -2.0, 1.0, 0.4, -0.5, 0.6], dtype=torch.float64))
ROWS = tuple(tuple(row) for row in TURNED.matrix().tolist())
BUDAPEST = Anchor(47.4734, 19.0598, 150.2, ROWS, metres_per_unit=2.0, position_sigma=0.3, orientation_sigma=0.4)
COVARIANCE = torch.diag(torch.tensor([1e-4, 4e-4, 1e-4, 1e-6, 1e-6, 1e-6], dtype=torch.float64))
POSE = SE3.exp(torch.tensor([1.0, 2.0, 3.0, 0.7, -0.2, 0.3], dtype=torch.float64))


def localization(outcome: Outcome = Outcome.CONVERGED) -> Localization:
    losses = torch.zeros(1, dtype=torch.float64)
    return Localization(POSE, outcome, "because", 1, 0.1, 0.0, "auto", SE3.stack([POSE]), losses, COVARIANCE)


def asked(anchor: Anchor | None, found: Localization, **more: Any) -> tuple[dict[str, Any], Any]:
    """Return an answer of the protocol, and what was localized."""
    picture = io.BytesIO()
    Image.fromarray(np.zeros((24, 32, 3), np.uint8)).save(picture, "PNG")
    reading = {
        "imageBytes": base64.b64encode(picture.getvalue()).decode(),
        "imageFormat": "PNG",
        "size": [32, 24],
        "params": {"model": "PINHOLE", "modelParams": [30, 30, 16, 12]},
    }
    body = {"id": "7", "sensorReadings": {"cameraReadings": [reading | more.pop("reading", {})]}} | more
    uploads = []

    def localize(upload: Any) -> Any:
        uploads.append(upload)
        return Answer("camera", 0, Intrinsics(30, 30, 16, 12, 32, 24), found), {"outcome": str(found.outcome)}

    request = validate(GeoPoseRequest, body)
    return answers.answer(anchor, request, localize), uploads[0]


def pose_in(body: dict[str, Any]) -> GeographicPose:
    """Return the pose of a camera that a geopose states."""
    from scipy.spatial.transform import Rotation

    position, q = body["geopose"]["position"], body["geopose"]["quaternion"]
    R_enu_body = torch.from_numpy(Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]]).as_matrix())
    R_enu_camera = R_enu_body @ answers.R_CAMERA_BODY.mT
    return GeographicPose(Geodetic(position["lat"], position["lon"], position["h"]), R_enu_camera)


def test_a_geopose_is_the_pose_and_its_accuracy_the_covariance() -> None:
    body, upload = asked(BUDAPEST, localization())
    assert (body["type"], body["id"]) == ("geopose", "7")
    assert torch.allclose(pose_in(body).in_map(BUDAPEST).matrix(), POSE.matrix(), atol=1e-6)
    position, orientation = math.sqrt(2e-4), math.degrees(1e-3)
    assert body["accuracy"]["position"] == pytest.approx(math.hypot(2 * position, 0.3))
    assert body["accuracy"]["orientation"] == pytest.approx(math.hypot(orientation, 0.4))
    assert upload.parameters["camera"] == "1 PINHOLE 32 24 30.0 30.0 16.0 12.0\n"


def test_a_camera_that_looks_east_is_not_rotated() -> None:
    """OGC 21-056r11: without a rotation, x points east, y north and z up."""
    east = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64)  # R_enu_camera
    looking = replace(localization(), T_world_camera=SE3(east, torch.zeros(3, dtype=torch.float64)))
    body = asked(Anchor(47.0, 19.0, 100.0), looking)[0]
    assert [body["geopose"]["quaternion"][key] for key in "xyzw"] == pytest.approx([0, 0, 0, 1], abs=1e-9)


def test_without_an_anchor_the_pose_is_local() -> None:
    body = asked(None, localization())[0]
    assert body["type"] == "localpose"
    assert "geopose" not in body
    assert [body["localpose"]["position"][key] for key in "xyz"] == pytest.approx(POSE.translation.tolist())
    assert body["accuracy"]["position"] == pytest.approx(math.sqrt(2e-4))
    unknown = asked(None, replace(localization(), covariance=None))[0]
    assert unknown["accuracy"] is None


def test_a_rejected_pose_is_never_a_geopose() -> None:
    with pytest.raises(Refused, match=r"^not localized: ambiguous: because$") as refused:
        asked(BUDAPEST, localization(Outcome.AMBIGUOUS))
    assert refused.value.status == 422
    assert refused.value.more == {"localization": {"outcome": "ambiguous"}}


def test_the_last_prior_pose_is_the_start() -> None:
    prior = asked(BUDAPEST, localization())[0]
    elsewhere = {"geopose": {**prior["geopose"], "position": {"lat": 1.0, "lon": 2.0, "h": 3.0}}}
    _, upload = asked(BUDAPEST, localization(), priorPoses=[elsewhere, prior])
    start = torch.tensor(json.loads(upload.parameters["start"])["T_world_camera"], dtype=torch.float64)
    assert torch.allclose(start, POSE.matrix(), atol=1e-6)
    assert "start" not in asked(None, localization(), priorPoses=[prior])[1].parameters
    for anchor in (BUDAPEST, None):  # with which it would be of no use either
        for wrong in ([{"geopose": {}}], [{"geopose": {}}, prior]):
            with pytest.raises(InputError, match=r"no 'priorPoses\.0\.geopose\.position'"):
                asked(anchor, localization(), priorPoses=wrong)


def test_raw_pixels_are_an_image() -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 4), np.uint8)
    for kind, part in (("RGBA32", pixels), ("GRAY8", pixels[..., 0])):
        raw = base64.b64encode(np.ascontiguousarray(part).tobytes()).decode()
        _, upload = asked(BUDAPEST, localization(), reading={"imageFormat": kind, "imageBytes": raw})
        found = np.asarray(Image.open(io.BytesIO(upload.files["photo"])))
        assert np.array_equal(found, part[..., :3] if kind == "RGBA32" else part)
    with pytest.raises(InputError, match="expected size and width x height x 4 bytes"):
        asked(BUDAPEST, localization(), reading={"imageFormat": "RGBA32", "imageBytes": raw})


def test_requests_that_contradict_the_protocol_are_refused_with_the_part_that_is_wrong() -> None:
    for reading, part in (
        ({"imageBytes": "?"}, "not base64"),
        ({"imageBytes": ""}, "imageBytes"),
        ({"imageFormat": "DEPTH"}, "expected a colour image"),
        ({"params": {"model": "KODAK", "modelParams": [1]}}, "model is 'KODAK'"),
        ({"imageOrientation": {"mirrored": True}}, "imageOrientation"),
        ({"size": [2]}, "size"),
    ):
        with pytest.raises(InputError, match=part):
            asked(BUDAPEST, localization(), reading=reading)
    prior = {
        "geopose": {
            "position": {"lat": 1, "lon": "2", "h": 3},
            "quaternion": {"x": 0, "y": 0, "z": 0, "w": 1},
        }
    }
    stretched = {"geopose": {"position": {"lat": 1, "lon": 2, "h": 3}, "quaternion": {"x": 0, "y": 0, "z": 0, "w": 2}}}
    endless = {"geopose": stretched["geopose"] | {"quaternion": dict.fromkeys("xyzw", 1.7e308)}}
    for wrong, part in (
        ({"timestamp": "now"}, "timestamp"),
        ({"type": 1}, "type"),
        ({"sensors": [1]}, "sensors.0"),
        ({"sensors": [{"id": 1}]}, "sensors.0.id"),
        ({"priorPoses": {}}, "priorPoses"),
        ({"priorPoses": [prior]}, "position.lon"),
        ({"priorPoses": [stretched]}, "expected length 1, not 2"),
        ({"priorPoses": [endless]}, "expected length 1, not inf"),
        ({"sensorReadings": {"cameraReadings": []}}, "cameraReadings"),
    ):
        with pytest.raises(InputError, match=part):
            asked(None, localization(), **wrong)
    assert asked(None, localization(), timestamp=None, priorPoses=None)[0]["type"] == "localpose"


def test_answers_are_those_of_the_description() -> None:
    for anchor in (BUDAPEST, None):
        GEOPOSE.response.model_validate(asked(anchor, localization())[0])


def test_a_service_with_the_plugin_describes_its_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fastapi", reason="the extra 'serve' is not installed")
    monkeypatch.setitem(registered, ("services", "geopose"), GEOPOSE)
    paths = service_app(["a", "b"]).openapi()["paths"]
    (name,) = paths["/geopose"]["post"]["parameters"]
    assert (name["name"], name["required"], name["schema"]["enum"]) == ("map", True, ["a", "b"])
    answered = paths["/maps/{map}/geopose"]["post"]["responses"]["200"]["content"]
    assert set(answered) == {"application/json", GEOPOSE.media_type}
    assert set(paths["/geopose"]) == {"get", "post"}
