"""Images that are partly hidden, and images of a single colour."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

import baked
from bidnerf.evaluation import faulty
from bidnerf.results import pose_error
from bidnerf_bid import DRAWERS
from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame, View, is_blank
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import AutoConfig, Localization, Outcome
from optional import require
from problems import localize
from refusals import refused

QUICK = AutoConfig(points=500, hypotheses=64, refine_steps=0)
SIZE = baked.CAMERA.height


def locate(view: View, start: SE3 | None = None) -> Localization:
    return localize(baked.problem(view, start=start), "auto", QUICK, 0)


@pytest.mark.parametrize("name", ["uniform", "interest-points", "interest-regions"])
def test_hidden_pixels_are_not_drawn(name: str) -> None:
    view = baked.unseen()[0]
    hidden = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    hidden[:, : SIZE // 2] = True
    frame = replace(view.frame, hidden=hidden)
    pixels = DRAWERS[name](frame, 500, torch.Generator().manual_seed(0))  # type: ignore[arg-type]
    assert len(pixels) == 500
    assert int(pixels[:, 0].min()) >= SIZE // 2
    assert frame.to("cpu").hidden is hidden


@pytest.mark.parametrize(
    ("hidden", "found", "expected"),
    [
        (torch.zeros((2, 3), dtype=torch.bool), f"hidden is 3x2, but its camera expects {SIZE}x{SIZE}", None),
        (torch.ones((SIZE, SIZE), dtype=torch.bool), "hidden is all true", "something visible"),
    ],
)
def test_a_hidden_part_is_a_mask_of_the_image(hidden: torch.Tensor, found: str, expected: str | None) -> None:
    with refused(where="frame f", found=found, expected=expected):
        Frame("f", torch.zeros((SIZE, SIZE, 3)), baked.CAMERA, hidden=hidden)


def test_nothing_is_measured_where_the_scene_is_hidden() -> None:
    frame = baked.unseen()[0].frame
    hidden = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    hidden[:, SIZE // 2 :] = True
    masked = replace(frame, hidden=hidden)
    assert torch.equal(require(masked.depth), torch.where(hidden, 0, require(frame.depth)))
    mirrored = faulty(View(masked, SE3.identity()), "mirror", 0).frame.hidden
    assert torch.equal(require(mirrored), hidden.flip(1))


def test_a_hidden_board_does_not_matter() -> None:
    """A board near the camera, which covers two fifths of the image, more than the toy does."""
    view = baked.unseen()[0]
    depth, rgb, hidden = require(view.frame.depth).clone(), view.frame.rgb.clone(), torch.zeros(SIZE, SIZE).bool()
    hidden[:, : 2 * SIZE // 5] = True
    depth[hidden] = 0.5 * float(depth[depth > 0].min())
    rgb[hidden] = torch.rand((int(hidden.sum()), 3), generator=torch.Generator().manual_seed(0))
    found = locate(replace(view, frame=replace(view.frame, depth=depth, rgb=rgb, hidden=hidden)))
    assert found.converged
    assert float(pose_error(found.T_world_camera, view.T_ref_camera).translation) < 0.05


def test_an_image_of_a_single_colour_is_not_searched_for() -> None:
    view = baked.unseen()[0]
    grey = View(Frame("grey", torch.full((SIZE, SIZE, 3), 0.4), baked.CAMERA), SE3.identity())
    found = locate(grey)
    assert found.outcome is Outcome.UNDETERMINED
    assert "single colour" in found.reason
    start = locate(replace(grey), start=view.T_ref_camera)
    assert torch.equal(start.T_world_camera.matrix(), view.T_ref_camera.matrix())


def seconds(function: Callable[[], object]) -> float:
    times = []
    for _ in range(3):
        began = time.perf_counter()
        function()
        times.append(time.perf_counter() - began)
    return min(times)


def test_whether_a_large_image_is_blank_is_known_without_reading_every_pixel() -> None:
    camera = Intrinsics(3000.0, 3000.0, 2000.0, 1500.0, 4000, 3000)
    grey = torch.full((3000, 4000, 3), 100, dtype=torch.uint8)
    blank, textured = Frame("blank", grey, camera), grey.clone()
    textured[:, ::7] = 200
    assert is_blank(blank)
    assert not is_blank(Frame("stripes", textured, camera))
    hidden = torch.zeros((3000, 4000), dtype=torch.bool)
    hidden[:, ::7] = True
    assert is_blank(Frame("hidden stripes", textured, camera, hidden=hidden))
    assert seconds(lambda: is_blank(blank)) < 0.2 * seconds(lambda: blank.rgb)
