"""Places on the earth, and poses of cameras there."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bidnerf import SE3
from bidnerf_core.maps import Anchor
from bidnerf_geopose.earth import GeographicPose
from bidnerf_geopose.wgs84 import Geodetic, geodetic

places = st.builds(Geodetic, st.floats(-90, 90), st.floats(-179.99, 179.99), st.floats(-5000, 20000))
TURNED = SE3.exp(torch.tensor([3.0, -2.0, 1.0, 0.4, -0.5, 0.6], dtype=torch.float64))
ROWS = tuple(tuple(row) for row in TURNED.matrix().tolist())
BUDAPEST = Anchor(47.4734, 19.0598, 150.2, ROWS, metres_per_unit=2.0, position_sigma=0.3, orientation_sigma=0.4)


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
    back = GeographicPose.of(pose, BUDAPEST).in_map(BUDAPEST)
    assert torch.allclose(back.matrix(), pose.matrix(), atol=1e-6)


def test_an_anchor_at_its_own_place_is_exact() -> None:
    anchor = Anchor(47.0, 19.0, 100.0)
    found = GeographicPose.of(SE3(torch.eye(3), torch.tensor([0.0, 0.0, 7.0])), anchor)
    assert (found.place.latitude, found.place.longitude) == pytest.approx((47.0, 19.0), abs=1e-10)
    assert found.place.height == pytest.approx(107.0, abs=1e-6)
    assert torch.allclose(found.rotation, torch.eye(3, dtype=torch.float64), atol=1e-9)
    north = GeographicPose.of(SE3(torch.eye(3), torch.tensor([0.0, 1000.0, 0.0])), anchor).place
    assert north.latitude > 47.0
    assert north.latitude - 47.0 == pytest.approx(1000 / 111_166, rel=1e-3)
