"""Cameras of images that were turned by a quarter, cropped or stretched: they see what such images show."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf import Intrinsics
from bidnerf_core.camera import Orientation, cameras_at_size

LANDSCAPE = Intrinsics(520.0, 521.0, 310.0, 245.0, 640, 480, (0.05, -0.01, 0.001, 0.002))
TILTED = replace(LANDSCAPE, distortion=(0.0,) * 12 + (0.1, 0.0))
POINTS = torch.tensor([[0.1, -0.2, 1.0], [-0.4, 0.3, 2.0], [0.5, 0.1, 1.5]], dtype=torch.float64)


def test_quarter_turns_go_to_both_sides() -> None:
    one, other = LANDSCAPE.quarter_turns()
    assert (one.width, one.height) == (other.width, other.height) == (480, 640)
    assert {one, other} == {LANDSCAPE.upright(Orientation.from_exif(code)) for code in (6, 8)}
    assert one != other
    assert {camera for turned in (one, other) for camera in turned.quarter_turns()} >= {LANDSCAPE}
    assert TILTED.quarter_turns() == ()


@pytest.mark.parametrize(("width", "height", "scale"), [(480, 480, 1.0), (320, 180, 0.5), (640, 480, 1.0)])
def test_a_centre_crop_touches_two_edges(width: int, height: int, scale: float) -> None:
    part = LANDSCAPE.centre_crop(width, height)
    shift = torch.tensor([(640 * scale - width) / 2, (480 * scale - height) / 2], dtype=torch.float64)
    assert torch.allclose(part.project(POINTS) + shift, scale * LANDSCAPE.project(POINTS))
    assert float(shift.min()) == 0


def test_landscape_cameras_of_portrait_images_are_turned_to_either_side() -> None:
    one, other = LANDSCAPE.quarter_turns()
    assert cameras_at_size((LANDSCAPE,), 480, 640, "stretched") == ((one,), (other,))
