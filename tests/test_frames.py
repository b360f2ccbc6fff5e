"""Frames that do not fit their camera are told at once."""

from __future__ import annotations

import pytest
import torch

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.frames.frame import Frame

CAMERA = Intrinsics(10.0, 10.0, 4.0, 3.0, 8, 6)


def test_a_frame_of_another_size_than_its_camera_is_told() -> None:
    with pytest.raises(InputError, match="frame f: rgb is 6x8, its camera expects 8x6"):
        Frame("f", torch.zeros(8, 6, 3), CAMERA)
    with pytest.raises(InputError, match="frame f: depth is 4x3, its camera expects 8x6"):
        Frame("f", torch.zeros(6, 8, 3), CAMERA, torch.zeros(3, 4))


def test_depth_counts_where_something_was_measured() -> None:
    rgb, depth = torch.zeros(6, 8, 3), torch.zeros(6, 8)
    assert not Frame("f", rgb, CAMERA).has_depth
    assert not Frame("f", rgb, CAMERA, depth).has_depth
    depth[2, 3] = 1.5
    assert Frame("f", rgb, CAMERA, depth).has_depth


@pytest.mark.parametrize("channels", [1, 4])
def test_an_image_of_other_than_three_channels_is_told(channels: int) -> None:
    with pytest.raises(InputError, match=r"frame f: rgb has shape .*, expected \(height, width, 3\)"):
        Frame("f", torch.zeros(6, 8, channels), CAMERA)
