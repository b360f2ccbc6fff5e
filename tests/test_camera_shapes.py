"""Cameras of images of other shapes: turned by a quarter, cropped about the middle, or stretched."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from bidnerf_core.camera.intrinsics import (
    Intrinsics,
    cameras_at_size,
    centre_crop_cameras,
    median_camera,
    stretched_cameras,
)
from bidnerf_core.camera.orientation import QUARTER_TURNS
from bidnerf_core.localization.search.map_camera import map_camera
from bidnerf_core.mapping import Calibration

LANDSCAPE = Intrinsics(520.0, 521.0, 310.0, 245.0, 640, 480, (0.05, -0.01, 0.001, 0.002))
TILTED = replace(LANDSCAPE, distortion=(0.0,) * 12 + (0.1, 0.0))
POINTS = torch.tensor([[0.1, -0.2, 1.0], [-0.4, 0.3, 2.0], [0.5, 0.1, 1.5]], dtype=torch.float64)


def test_quarter_turns_go_to_both_sides() -> None:
    one, other = LANDSCAPE.quarter_turns()
    assert (one.width, one.height) == (other.width, other.height) == (480, 640)
    assert one != other
    assert {camera for turned in (one, other) for camera in turned.quarter_turns()} >= {LANDSCAPE}
    assert TILTED.quarter_turns() == ()


@pytest.mark.parametrize("number", [0, 1])
def test_a_turned_camera_sees_what_a_turned_image_shows(number: int) -> None:
    turned, orientation = LANDSCAPE.quarter_turns()[number], QUARTER_TURNS[number]
    angle = math.pi / 2 * (1 if orientation.mirrors_rows else -1)
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]],
        dtype=torch.float64,
    )
    u, v = LANDSCAPE.project(POINTS).unbind(-1)
    upright = torch.stack([480 - v, u] if orientation.mirrors_rows else [v, 640 - u], dim=-1)
    assert torch.allclose(turned.project(POINTS @ turn.mT), upright)


@pytest.mark.parametrize(("width", "height", "scale"), [(480, 480, 1.0), (320, 180, 0.5), (640, 480, 1.0)])
def test_a_centre_crop_touches_two_edges(width: int, height: int, scale: float) -> None:
    part = LANDSCAPE.centre_crop(width, height)
    shift = torch.tensor([(640 * scale - width) / 2, (480 * scale - height) / 2], dtype=torch.float64)
    assert torch.allclose(part.project(POINTS) + shift, scale * LANDSCAPE.project(POINTS))
    assert float(shift.min()) == 0


def test_the_map_camera_of_a_portrait_image_is_turned() -> None:
    given = Intrinsics.from_focal(540, 480, 640)
    found = map_camera(given, (LANDSCAPE,))
    assert found is not None
    assert found.intrinsics in LANDSCAPE.quarter_turns()
    assert found.calibration.focal_factor == pytest.approx(520.5 / 540, rel=0.005)
    one, other = LANDSCAPE.quarter_turns()
    for own in (one, other):
        taken = map_camera(own, (LANDSCAPE,))
        assert taken is not None
        assert taken.intrinsics == own
        near = Calibration(shift_u=(own.cx - given.cx) / given.fx, shift_v=(own.cy - given.cy) / given.fx)
        taken = map_camera(given, (LANDSCAPE, LANDSCAPE), near=near)
        assert taken is not None
        assert taken.intrinsics == own
    assert stretched_cameras((LANDSCAPE,), 480, 640) == ((one,), (other,))


def test_of_landscape_and_portrait_images_those_of_the_shape_of_the_query_are_taken() -> None:
    one, _ = LANDSCAPE.quarter_turns()
    portrait = replace(one, fx=500.0, fy=500.0)
    for cameras in ((LANDSCAPE, portrait), (portrait, LANDSCAPE)):
        found = map_camera(Intrinsics.from_focal(510, 480, 640), cameras)
        assert found is not None
        assert found.intrinsics == portrait
    assert map_camera(portrait, (TILTED,)) is None
    assert map_camera(portrait, ()) is None


def test_crops_are_compared_only_on_demand() -> None:
    square = Intrinsics.from_focal(400, 480, 480)
    assert map_camera(square, (LANDSCAPE,)) is None
    found = map_camera(square, (LANDSCAPE,), crops=True)
    assert found is not None
    assert found.intrinsics == LANDSCAPE.centre_crop(480, 480)
    whole = map_camera(
        Intrinsics.from_focal(400, 640, 480), (LANDSCAPE, LANDSCAPE.centre_crop(480, 480)), crops=True
    )
    assert whole is not None
    assert whole.intrinsics == LANDSCAPE


def test_single_images_of_another_shape_do_not_matter() -> None:
    """Nor does their order: shapes are compared before orientations."""
    tall, square = Intrinsics.from_focal(700, 360, 640), Intrinsics.from_focal(300, 100, 100)
    turned = cameras_at_size((LANDSCAPE,), 480, 640)
    assert len(turned) == 2
    assert cameras_at_size((tall, LANDSCAPE, square), 480, 640) == turned
    assert cameras_at_size((tall, square), 480, 640) == ()
    assert centre_crop_cameras((tall, square), 480, 640) == (
        (tall.centre_crop(480, 640), square.centre_crop(480, 640)),
    )
    assert cameras_at_size((), 480, 640) == stretched_cameras((), 480, 640) == ()
    assert centre_crop_cameras((), 480, 640) == ()
    both = stretched_cameras((tall, LANDSCAPE), 480, 640)
    assert [group[0] for group in both] == 2 * [tall.resized(480, 640)]
    assert [group[1] for group in both] == [group[0] for group in turned]


def test_the_lower_one_of_two_focal_lengths_is_the_median() -> None:
    cameras = [Intrinsics.from_focal(focal, 40, 30) for focal in (50, 30, 40, 60)]
    assert median_camera(tuple(cameras)).fx == 40
    assert median_camera(tuple(cameras[:3])).fx == 40
