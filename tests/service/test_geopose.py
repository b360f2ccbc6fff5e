"""Places on the earth, the anchor of a map, and the answers of the GeoPose Protocol."""

from __future__ import annotations

import base64
import io
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from bidnerf_core import SE3, InputError, Intrinsics, Localization, Outcome
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import Geodetic, geodetic
from bidnerf_core.maps import Anchor, GeographicPose, MapInfo, load_info, write_parts
from bidnerf_core.results import Answer

# Inside: the axes of the standard, and answers without a server
from bidnerf_core.service import geopose
from bidnerf_core.training import TrainingState

places = st.builds(Geodetic, st.floats(-90, 90), st.floats(-179.99, 179.99), st.floats(-5000, 20000))
TURNED = SE3.exp(torch.tensor([3.0, -2.0, 1.0, 0.4, -0.5, 0.6], dtype=torch.float64))
ROWS = tuple(tuple(row) for row in TURNED.matrix().tolist())
BUDAPEST = Anchor(
    47.4734, 19.0598, 150.2, ROWS, metres_per_unit=2.0, position_sigma=0.3, orientation_sigma=0.4
)


def test_known_places() -> None:
    """The ends of the axes, and an example of Ordnance Survey's guide to coordinate systems (on its own datum's scale)."""
    for place, expected in (
        (Geodetic(0, 0, 0), (6378137.0, 0, 0)),
        (Geodetic(0, 90, 10), (0, 6378147.0, 0)),
        (Geodetic(90, 0, 0), (0, 0, 6356752.314245)),
        (Geodetic(-90, 50, -5), (0, 0, -6356747.314245)),
        (Geodetic(45, 45, 0), (3194419.145, 3194419.145, 4487348.409)),
    ):
        assert place.ecef.tolist() == pytest.approx(expected, abs=1e-3)


@given(places)
def test_coordinates_survive_a_round_trip(place: Geodetic) -> None:
    found = geodetic(place.ecef)
    assert found.latitude == pytest.approx(place.latitude, abs=1e-9)
    assert found.height == pytest.approx(place.height, abs=1e-4)
    if abs(place.latitude) < 89.9:
        assert found.longitude == pytest.approx(place.longitude, abs=1e-9)


@given(places)
def test_local_axes_point_east_north_and_up(place: Geodetic) -> None:
    frame = place.T_ecef_enu
    assert bool(frame.is_rigid(1e-12))
    up = Geodetic(place.latitude, place.longitude, place.height + 1).ecef - place.ecef
    assert torch.allclose(frame.rotation[:, 2], up, atol=1e-6)
    assert abs(float(frame.rotation[2, 0])) < 1e-12  # east is level
    assert float(frame.rotation[2, 1]) >= -1e-12  # north is not southwards


@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_a_pose_on_the_earth_is_the_pose_in_the_map(tangent: list[float]) -> None:
    pose = SE3.exp(torch.tensor(tangent, dtype=torch.float64) * 50)
    back = BUDAPEST.T_world_camera(BUDAPEST.geographic(pose))
    assert torch.allclose(back.matrix(), pose.matrix(), atol=1e-6)


def test_an_anchor_at_its_own_place_is_exact() -> None:
    anchor = Anchor(47.0, 19.0, 100.0)
    found = anchor.geographic(SE3(torch.eye(3), torch.tensor([0.0, 0.0, 7.0])))
    assert (found.place.latitude, found.place.longitude) == pytest.approx((47.0, 19.0), abs=1e-10)
    assert found.place.height == pytest.approx(107.0, abs=1e-6)
    assert torch.allclose(found.rotation, torch.eye(3, dtype=torch.float64), atol=1e-9)
    north = anchor.geographic(SE3(torch.eye(3), torch.tensor([0.0, 1000.0, 0.0]))).place
    assert north.latitude > 47.0
    assert north.latitude - 47.0 == pytest.approx(1000 / 111_166, rel=1e-3)


def test_damaged_anchors_are_refused(tmp_path: Path) -> None:
    write_parts(tmp_path, MapInfo("hashgrid", {}, SceneBounds((0, 0, 0), (1, 1, 1), 0, 1), 1, True), TrainingState(1, {}, {}))
    assert load_info(tmp_path).anchor is None
    good: dict[str, Any] = {"latitude": 47.0, "longitude": 19.0, "height": 100.0}
    (tmp_path / "anchor.json").write_text(json.dumps(good))
    assert load_info(tmp_path).anchor == Anchor(**good)
    for change, part in (
        ({"latitude": 91.0}, "latitude is 91"),
        ({"longitude": None}, "longitude"),
        ({"T_enu_world": [[1.0]]}, "4 rows"),
        ({"T_enu_world": [[2.0, 0.0, 0.0, 0.0], *[[0.0] * 4] * 3]}, "T_enu_world"),
        ({"metres_per_unit": 0.0}, "metres_per_unit is 0"),
        ({"position_sigma": -1.0}, "expected 0 or more"),
        ({"lattitude": 1.0}, "latitude"),
    ):
        (tmp_path / "anchor.json").write_text(json.dumps(good | change))
        with pytest.raises(InputError, match=r"anchor\.json: .*" + part):
            load_info(tmp_path)


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
        "imageBytes": base64.b64encode(picture.getvalue()).decode(), "imageFormat": "PNG", "size": [32, 24],
        "params": {"model": "PINHOLE", "modelParams": [30, 30, 16, 12]},
    }  # fmt: skip
    body = {"id": "7", "sensorReadings": {"cameraReadings": [reading | more.pop("reading", {})]}} | more
    uploads = []

    def localize(upload: Any) -> Any:
        uploads.append(upload)
        return Answer("camera", 0, Intrinsics(30, 30, 16, 12, 32, 24), found), {"outcome": str(found.outcome)}

    return geopose.answer(anchor, body, localize), uploads[0]


def pose_in(body: dict[str, Any]) -> GeographicPose:
    """Return the pose of a camera that a geopose states."""
    from scipy.spatial.transform import Rotation

    position, q = body["geopose"]["position"], body["geopose"]["quaternion"]
    R_enu_body = torch.from_numpy(Rotation.from_quat([q["x"], q["y"], q["z"], q["w"]]).as_matrix())
    R_enu_camera = R_enu_body @ geopose.R_CAMERA_BODY.mT
    return GeographicPose(Geodetic(position["lat"], position["lon"], position["h"]), R_enu_camera)


def test_a_geopose_is_the_pose_and_its_accuracy_the_covariance() -> None:
    answer, upload = asked(BUDAPEST, localization())
    body = answer["body"]
    assert (answer["status"], body["type"], body["id"]) == (200, "geopose", "7")
    assert torch.allclose(BUDAPEST.T_world_camera(pose_in(body)).matrix(), POSE.matrix(), atol=1e-6)
    position, orientation = math.sqrt(2e-4), math.degrees(1e-3)
    assert body["accuracy"]["position"] == pytest.approx(math.hypot(2 * position, 0.3))
    assert body["accuracy"]["orientation"] == pytest.approx(math.hypot(orientation, 0.4))
    assert upload.blocks["camera"] == b"1 PINHOLE 32 24 30.0 30.0 16.0 12.0\n"


def test_a_camera_that_looks_east_is_not_rotated() -> None:
    """OGC 21-056r11: without a rotation, x points east, y north and z up."""
    east = torch.tensor(
        [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], dtype=torch.float64
    )  # R_enu_camera
    looking = replace(localization(), T_world_camera=SE3(east, torch.zeros(3, dtype=torch.float64)))
    body = asked(Anchor(47.0, 19.0, 100.0), looking)[0]["body"]
    assert [body["geopose"]["quaternion"][key] for key in "xyzw"] == pytest.approx([0, 0, 0, 1], abs=1e-9)


def test_without_an_anchor_the_pose_is_local() -> None:
    body = asked(None, localization())[0]["body"]
    assert body["type"] == "localpose"
    assert "geopose" not in body
    assert [body["localpose"]["position"][key] for key in "xyz"] == pytest.approx(POSE.translation.tolist())
    assert body["accuracy"]["position"] == pytest.approx(math.sqrt(2e-4))
    unknown = asked(None, replace(localization(), covariance=None))[0]["body"]
    assert unknown["accuracy"] is None


def test_a_rejected_pose_is_never_a_geopose() -> None:
    answer = asked(BUDAPEST, localization(Outcome.AMBIGUOUS))[0]
    assert answer["status"] == 422
    assert "body" not in answer
    assert answer["detail"] == "not localized: ambiguous: because"


def test_the_last_prior_pose_is_the_start() -> None:
    prior = asked(BUDAPEST, localization())[0]["body"]
    elsewhere = {"geopose": {**prior["geopose"], "position": {"lat": 1.0, "lon": 2.0, "h": 3.0}}}
    _, upload = asked(BUDAPEST, localization(), priorPoses=[elsewhere, prior])
    start = torch.tensor(json.loads(upload.blocks["start"])["T_world_camera"], dtype=torch.float64)
    assert torch.allclose(start, POSE.matrix(), atol=1e-6)
    assert "start" not in asked(None, localization(), priorPoses=[prior])[1].blocks
    for anchor in (BUDAPEST, None):  # with which it would be of no use either
        for wrong in ([{"geopose": {}}], [{"geopose": {}}, prior]):
            with pytest.raises(InputError, match="no 'lat'"):
                asked(anchor, localization(), priorPoses=wrong)


def test_raw_pixels_are_an_image() -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (24, 32, 4), np.uint8)
    for kind, part in (("RGBA32", pixels), ("GRAY8", pixels[..., 0])):
        raw = base64.b64encode(np.ascontiguousarray(part).tobytes()).decode()
        _, upload = asked(BUDAPEST, localization(), reading={"imageFormat": kind, "imageBytes": raw})
        found = np.asarray(Image.open(io.BytesIO(upload.blocks["photo"])))
        assert np.array_equal(found, part[..., :3] if kind == "RGBA32" else part)
    with pytest.raises(InputError, match="expected size and width x height x 4 bytes"):
        asked(BUDAPEST, localization(), reading={"imageFormat": "RGBA32", "imageBytes": raw})
