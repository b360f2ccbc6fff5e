"""Cameras of images of other shapes: turned by a quarter, and parts about the middle."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.localization.search.map_camera import map_camera, resized_cameras
from bidnerf_core.mapping.calibration import Calibration
from bidnerf_core.orientation import QUARTER_TURNS

LYING = Intrinsics(520.0, 521.0, 310.0, 245.0, 640, 480, (0.05, -0.01, 0.001, 0.002))
POINTS = torch.tensor([[0.1, -0.2, 1.0], [-0.4, 0.3, 2.0], [0.5, 0.1, 1.5]], dtype=torch.float64)


def test_only_cameras_of_images_that_lie_are_turned_for_one_that_stands() -> None:
    assert LYING.turned_like(1920, 1080) == (LYING,)
    assert LYING.turned_like(300, 300) == (LYING,)
    one, other = LYING.turned_like(480, 640)
    assert (one.width, one.height) == (other.width, other.height) == (480, 640)
    assert one != other
    assert {camera for turned in (one, other) for camera in turned.turned_like(640, 480)} >= {LYING}
    tilted = replace(LYING, distortion=(0.0,) * 12 + (0.1, 0.0))
    assert tilted.turned_like(480, 640) == ()
    assert tilted.turned_like(640, 480) == (tilted,)


@pytest.mark.parametrize("number", [0, 1])
def test_a_turned_camera_sees_what_a_turned_image_shows(number: int) -> None:
    turned, orientation = LYING.turned_like(480, 640)[number], QUARTER_TURNS[number]
    angle = math.pi / 2 * (1 if orientation.mirrors_rows else -1)
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]],
        dtype=torch.float64,
    )
    u, v = LYING.project(POINTS).unbind(-1)
    upright = torch.stack([480 - v, u] if orientation.mirrors_rows else [v, 640 - u], dim=-1)
    assert torch.allclose(turned.project(POINTS @ turn.mT), upright)


@pytest.mark.parametrize(("width", "height", "scale"), [(480, 480, 1.0), (320, 180, 0.5), (640, 480, 1.0)])
def test_the_largest_part_touches_two_edges(width: int, height: int, scale: float) -> None:
    part = LYING.largest_part(width, height)
    shift = torch.tensor([(640 * scale - width) / 2, (480 * scale - height) / 2], dtype=torch.float64)
    assert torch.allclose(part.project(POINTS) + shift, scale * LYING.project(POINTS))
    assert float(shift.min()) == 0


def test_the_map_camera_of_an_image_that_stands_is_turned() -> None:
    given = Intrinsics.from_focal(540, 480, 640)
    found = map_camera(given, (LYING,))
    assert found is not None
    assert found.intrinsics in LYING.turned_like(480, 640)
    assert found.calibration.focal_factor == pytest.approx(520.5 / 540, rel=0.005)
    one, other = LYING.turned_like(480, 640)
    for own in (one, other):
        taken = map_camera(own, (LYING,))
        assert taken is not None
        assert taken.intrinsics == own
        near = Calibration(shift_u=(own.cx - given.cx) / given.fx, shift_v=(own.cy - given.cy) / given.fx)
        taken = map_camera(given, (LYING, LYING), near=near)
        assert taken is not None
        assert taken.intrinsics == own
    assert set(resized_cameras([LYING], given)) == {one, other}


def test_of_images_that_lie_and_stand_those_that_lie_as_the_query_are_taken() -> None:
    one, _ = LYING.turned_like(480, 640)
    standing = replace(one, fx=500.0, fy=500.0)
    for cameras in ((LYING, standing), (standing, LYING)):
        found = map_camera(Intrinsics.from_focal(510, 480, 640), cameras)
        assert found is not None
        assert found.intrinsics == standing
    tilted = replace(LYING, distortion=(0.0,) * 12 + (0.1, 0.0))
    assert map_camera(standing, (tilted,)) is None
    assert map_camera(standing, ()) is None


def test_parts_are_compared_only_on_demand() -> None:
    square = Intrinsics.from_focal(400, 480, 480)
    assert map_camera(square, (LYING,)) is None
    found = map_camera(square, (LYING,), parts=True)
    assert found is not None
    assert found.intrinsics == LYING.largest_part(480, 480)
    whole = map_camera(
        Intrinsics.from_focal(400, 640, 480), (LYING, LYING.largest_part(480, 480)), parts=True
    )
    assert whole is not None
    assert whole.intrinsics == LYING
