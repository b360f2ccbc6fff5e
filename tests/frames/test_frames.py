"""Frames that do not fit their camera are told at once."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from bidnerf.testing import unseen
from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame, observe
from bidnerf_core.geometry import SE3
from optional import require
from refusals import refused

LENS = Intrinsics(20, 20, 12, 8, 24, 16)
GOOD = {"rgb": torch.rand(16, 24, 3), "depth": torch.rand(16, 24), "alpha": torch.rand(16, 24)}
NO_VALUES = torch.zeros(16, 24, 3)
FINITE, MEASURED = "finite numbers", "measured values"
WRONG: list[tuple[dict[str, Any], str, str | None]] = [
    ({"intrinsics": None}, "camera is a NoneType", "Intrinsics"),
    ({"intrinsics": {"fx": 1}}, "camera is a dict", "Intrinsics"),
    (
        {"intrinsics": replace(LENS, distortion=(-1e6,) * 14)},
        "maps no ray to some of its pixels",
        "a real lens",
    ),
    ({"rgb": None}, "rgb is a NoneType", "a tensor"),
    ({"rgb": NO_VALUES.numpy()}, "rgb is a ndarray", "a tensor; Frame.from_numpy takes arrays"),
    ({"rgb": NO_VALUES.index_fill(0, torch.tensor([3]), torch.nan)}, "rgb has values that are NaN", FINITE),
    ({"rgb": NO_VALUES.index_fill(2, torch.tensor([1]), torch.inf)}, "NaN or infinite", FINITE),
    *(
        (
            {"rgb": NO_VALUES.to(dtype)},
            f"rgb has dtype {str(dtype).removeprefix('torch.')}",
            "bytes or floats",
        )
        for dtype in (torch.int16, torch.bool, torch.int64, torch.complex64)
    ),
    ({"rgb": NO_VALUES.to_sparse()}, "rgb is a sparse tensor", "a dense one"),
    ({"rgb": NO_VALUES.to("meta")}, "has no values", "a dense one"),
    ({"rgb": NO_VALUES.clone().requires_grad_()}, "rgb requires a gradient", MEASURED),
    *(({"rgb": x}, "rgb has shape", "(height, width, 3)") for x in (NO_VALUES[..., 0], torch.zeros(16, 24, 4))),
    ({"rgb": torch.zeros(16, 24, 1)}, "rgb has shape", "(height, width, 3)"),
    ({"rgb": torch.zeros(24, 16, 3)}, "rgb is 16x24, but its camera expects 24x16", None),
    ({"depth": torch.zeros(8, 12)}, "depth is 12x8, but its camera expects 24x16", None),
    ({"depth": torch.zeros(16, 24, 1)}, "depth has shape", "(height, width)"),
    ({"depth": np.zeros((16, 24))}, "depth is a ndarray", "a tensor"),
    ({"alpha": torch.full((16, 24), torch.nan)}, "alpha has values that are NaN", FINITE),
    ({"alpha": torch.zeros(24)}, "alpha has shape", "(height, width)"),
    ({"hidden": [False]}, "hidden is a list", "a tensor"),
    ({"hidden": "all"}, "hidden is a str", "a tensor"),
    ({"hidden": torch.zeros(16, 24, 1, dtype=torch.bool)}, "hidden has shape", "(height, width)"),
    ({"hidden": torch.zeros(16, 24)}, "hidden has dtype", "booleans"),
]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("changed", "found", "expected"), WRONG, ids=range(len(WRONG)))
def test_what_is_no_frame_is_refused_where_it_is_made(
    changed: dict[str, Any], found: str, expected: str | None
) -> None:
    """Otherwise it would fail somewhere in a localization, with another error at each place."""
    parts: dict[str, Any] = {"name": "a", "intrinsics": LENS} | GOOD
    Frame(**parts)
    with refused(where="frame a", found=found, expected=expected):
        Frame(**parts | changed)


def test_depth_that_is_no_number_was_not_measured() -> None:
    depth = torch.tensor([1.0, torch.nan, torch.inf, -torch.inf]).repeat(16, 6)
    found = require(Frame("a", GOOD["rgb"], LENS, depth).depth)
    assert torch.equal(found, torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(16, 6))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("camera", [None, np.eye(3), (20.0, 20.0, 12.0, 8.0), "camera.json"])
def test_arrays_need_intrinsics(camera: Any) -> None:
    with refused(where="frame image", found=f"camera is a {type(camera).__name__}", expected="Intrinsics(fx="):
        Frame.from_numpy(np.zeros((16, 24, 3), np.uint8), camera)


def test_rays_of_a_moving_view_start_where_the_camera_was_at_their_rows() -> None:
    view = unseen()
    camera = view.frame.intrinsics
    motion = torch.tensor([0.02, -0.01, 0.03, 0.01, 0.03, -0.02], dtype=torch.float64)
    pixels = torch.tensor([[10, 0], [10, camera.height // 2], [30, camera.height - 1]])
    found = observe(replace(view, motion=motion), pixels, torch.float64)
    for number, (_, row) in enumerate(pixels.tolist()):
        moment = (row + 0.5) / camera.height - 0.5
        there = replace(view, T_ref_camera=view.T_ref_camera @ SE3.exp(moment * motion))
        expected = observe(there, pixels[number : number + 1], torch.float64)
        torch.testing.assert_close(found.origins[number], expected.origins[0])
        torch.testing.assert_close(found.points[number], expected.points[0])
