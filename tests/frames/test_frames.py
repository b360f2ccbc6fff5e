"""Frames that do not fit their camera are told at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame

CAMERA = Intrinsics(10.0, 10.0, 4.0, 3.0, 8, 6)


def test_a_frame_of_another_size_than_its_camera_is_told() -> None:
    with pytest.raises(InputError, match="frame f: rgb is 6x8, but its camera expects 8x6"):
        Frame("f", torch.zeros(8, 6, 3), CAMERA)
    with pytest.raises(InputError, match="frame f: depth is 4x3, but its camera expects 8x6"):
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


LENS = Intrinsics(20, 20, 12, 8, 24, 16)
GOOD = {"rgb": torch.rand(16, 24, 3), "depth": torch.rand(16, 24), "alpha": torch.rand(16, 24)}
NO_VALUES = torch.zeros(16, 24, 3)
WRONG = [
    ({"intrinsics": None}, "intrinsics is a NoneType"),
    ({"intrinsics": {"fx": 1}}, "intrinsics is a dict"),
    ({"intrinsics": replace(LENS, distortion=(-1e6,) * 14)}, "maps no ray to some of its pixels"),
    ({"rgb": None}, "rgb is a NoneType"),
    ({"rgb": NO_VALUES.numpy()}, "rgb is a ndarray, expected a tensor; Frame.from_numpy"),
    ({"rgb": NO_VALUES.index_fill(0, torch.tensor([3]), torch.nan)}, "rgb has values that are NaN"),
    ({"rgb": NO_VALUES.index_fill(2, torch.tensor([1]), torch.inf)}, "rgb has values that are NaN or inf"),
    ({"rgb": NO_VALUES.short()}, "rgb has dtype int16, expected bytes or floats"),
    ({"rgb": NO_VALUES.bool()}, "rgb has dtype bool"),
    ({"rgb": NO_VALUES.long()}, "rgb has dtype int64"),
    ({"rgb": NO_VALUES.to(torch.complex64)}, "rgb has dtype complex64"),
    ({"rgb": NO_VALUES.to_sparse()}, "rgb is a sparse tensor"),
    ({"rgb": NO_VALUES.to("meta")}, "has no values"),
    ({"rgb": NO_VALUES.clone().requires_grad_()}, "rgb requires a gradient"),
    ({"rgb": NO_VALUES[..., 0]}, "rgb has shape"),
    ({"depth": torch.zeros(16, 24, 1)}, "depth has shape"),
    ({"depth": np.zeros((16, 24))}, "depth is a ndarray"),
    ({"alpha": torch.full((16, 24), torch.nan)}, "alpha has values that are NaN"),
    ({"alpha": torch.zeros(24)}, "alpha has shape"),
    ({"hidden": [False]}, "hidden is a list"),
    ({"hidden": "all"}, "hidden is a str"),
    ({"hidden": torch.zeros(16, 24, 1, dtype=torch.bool)}, "hidden has shape"),
    ({"hidden": torch.zeros(16, 24)}, "expected booleans"),
]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("changed", "said"), WRONG, ids=range(len(WRONG)))
def test_what_is_no_frame_is_refused_where_it_is_made(changed: dict[str, Any], said: str) -> None:
    """Otherwise it would fail somewhere in a localization, with another error at each place."""
    parts: dict[str, Any] = {"name": "a", "intrinsics": LENS} | GOOD
    Frame(**parts)
    with pytest.raises(InputError, match=f"^frame a: .*{said}"):
        Frame(**parts | changed)


def test_real_lenses_have_rays() -> None:
    for distortion in ((-0.3, 0.1, 0.0, 0.0), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)):
        assert Frame("a", GOOD["rgb"], replace(LENS, distortion=distortion)).intrinsics.distortion


def test_depth_that_is_no_number_was_not_measured() -> None:
    depth = torch.tensor([1.0, torch.nan, torch.inf, -torch.inf]).repeat(16, 6)
    found = Frame("a", GOOD["rgb"], LENS, depth).depth
    assert found is not None
    assert torch.equal(found, torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(16, 6))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("camera", [None, np.eye(3), (20.0, 20.0, 12.0, 8.0), "camera.json"])
def test_arrays_need_intrinsics(camera: Any) -> None:
    with pytest.raises(InputError, match=r"frame image: camera is a \w+, expected Intrinsics\(fx="):
        Frame.from_numpy(np.zeros((16, 24, 3), np.uint8), camera)
