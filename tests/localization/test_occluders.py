"""Something in front of the scene: it is cut out of the depth image, and the pose is found without it.

``nearest_piece`` is needed here for which pixels are taken for an occluder.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

import baked
from bidnerf.evaluation import faulty
from bidnerf.results import pose_error
from bidnerf_core.frames import DRAWERS, Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import AutoConfig, Localization

# Inside: which pixels are an occluder, of which an answer shows no image
from bidnerf_core.localization.by_surface import nearest_piece
from optional import require
from problems import localize
from refusals import refused

QUICK = AutoConfig(points=500, hypotheses=64, refine_steps=0)
SIZE = baked.CAMERA.height


def seen(depth: torch.Tensor) -> View:
    rgb = torch.zeros((*depth.shape, 3))
    return View(Frame("seen", rgb, replace(baked.CAMERA), depth), SE3.identity())


def wall(box: tuple[slice, slice] | None = None, nearer: float = 1.0) -> torch.Tensor:
    """A slanted wall about 2 m away, with a piece of it at ``nearer`` times its depth."""
    depth = torch.linspace(1.8, 2.2, SIZE).expand(SIZE, SIZE).clone()
    if box is not None:
        depth[box] *= nearer
    return depth


def behind_a_board(view: View) -> View:
    """A board near the camera, which covers two fifths of the image, more than the toy does."""
    depth, rgb = view.frame.depth, view.frame.rgb.clone()
    assert depth is not None
    board, depth = slice(0, 2 * SIZE // 5), depth.clone()
    depth[:, board] = 0.5 * float(depth[depth > 0].min())
    rgb[:, board] = torch.rand((SIZE, 2 * SIZE // 5, 3), generator=torch.Generator().manual_seed(0))
    return replace(view, frame=replace(view.frame, depth=depth, rgb=rgb))


def found_for(view: View, config: AutoConfig = QUICK) -> Localization:
    return localize(baked.problem(view), "auto", config, 0)


def test_the_nearest_piece_is_cut_out_along_its_edges() -> None:
    box = (slice(10, 50), slice(20, 60))
    depth = wall(box, 0.6)
    occluder = require(nearest_piece(baked.problem(seen(depth))))
    frame = occluder.rest.views[0].frame
    inside = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    inside[box] = True
    assert torch.equal(require(frame.hidden), inside)
    assert torch.equal(require(frame.depth), torch.where(inside, 0, depth))
    assert occluder.share == pytest.approx(40 * 40 / SIZE**2)
    expected = depth[box].double()
    assert float(occluder.points[:, 2].min()) == pytest.approx(float(expected.min()), rel=1e-6)
    back = baked.CAMERA.project(occluder.points.double()).floor().long()
    assert bool(inside[back[:, 1], back[:, 0]].all())


def test_an_approximate_focal_length_is_no_better_known_behind_a_board() -> None:
    view = behind_a_board(baked.unseen()[0])
    assert found_for(view).converged
    unsure = replace(view, frame=replace(view.frame, focal_is_approximate=True))
    assert not found_for(unsure, replace(QUICK, rounds=1)).converged


@pytest.mark.parametrize(
    "depth",
    [
        wall(),  # one piece
        wall((slice(0, 10), slice(0, 10)), 0.5),  # too small
        wall((slice(0, 72), slice(0, 71)), 0.5),  # nothing is left
        torch.zeros((SIZE, SIZE)),
    ],
    ids=["one piece", "small", "all", "nothing measured"],
)
def test_not_every_image_has_an_occluder(depth: torch.Tensor) -> None:
    assert nearest_piece(baked.problem(seen(depth))) is None


def test_rigs_and_images_without_depth_have_none() -> None:
    view = seen(wall((slice(10, 50), slice(20, 60)), 0.6))
    assert nearest_piece(baked.problem(view, view)) is None
    bare = replace(view, frame=replace(view.frame, depth=None))
    assert nearest_piece(baked.problem(bare)) is None


def test_only_what_is_in_front_of_the_surface_hides_it() -> None:
    view = baked.unseen()[0]
    depth = require(view.frame.depth)
    half = torch.zeros_like(depth, dtype=torch.bool)
    half[:, : SIZE // 2] = depth[:, : SIZE // 2] > 0
    for factor, expected in ((0.6, 1.0), (1.0, 0.0), (1.4, 0.0)):
        # Whatever the factor, this half is the nearest piece.
        moved = torch.where(half, factor * depth, 3 * depth)
        occluder = require(nearest_piece(baked.problem(replace(view, frame=replace(view.frame, depth=moved)))))
        in_front = occluder.share_in_front(baked.toy(), view.T_ref_camera)
        assert in_front == pytest.approx(expected, abs=0.15), factor


def test_what_the_user_hides_stays_hidden() -> None:
    view = seen(wall((slice(10, 50), slice(20, 60)), 0.6))
    own = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    own[:10] = True
    occluder = require(nearest_piece(baked.problem(replace(view, frame=replace(view.frame, hidden=own)))))
    hidden = require(occluder.rest.views[0].frame.hidden)
    assert bool(hidden[:10].all())
    assert bool(hidden[10:50, 20:60].all())
    assert int(hidden.sum()) == 10 * SIZE + 40 * 40


@pytest.mark.parametrize("number", range(2))
def test_a_pose_is_found_behind_something_of_which_more_was_measured(number: int) -> None:
    view = behind_a_board(baked.unseen()[number])
    found = found_for(view)
    error = pose_error(found.T_world_camera, view.T_ref_camera)
    assert found.converged, found.reason
    assert "which are on an occluder" in found.reason
    assert float(error.translation) < 0.05
    assert float(error.rotation_deg) < 1.5


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
    mirrored = require(faulty(View(masked, SE3.identity()), "mirror", 0).frame.hidden)
    assert torch.equal(mirrored, hidden.flip(1))


def test_a_hidden_board_does_not_matter() -> None:
    view = behind_a_board(baked.unseen()[0])
    hidden = torch.zeros((SIZE, SIZE), dtype=torch.bool)
    hidden[:, : 2 * SIZE // 5] = True
    found = found_for(replace(view, frame=replace(view.frame, hidden=hidden)))
    assert found.converged
    assert "in front" not in found.reason
    assert float(pose_error(found.T_world_camera, view.T_ref_camera).translation) < 0.05


def test_what_is_behind_the_surface_was_no_occluder() -> None:
    """The nearest piece of the image is the toy itself, whose other half seems to be far behind it."""
    view = baked.unseen()[0]
    depth, rgb = view.frame.depth, view.frame.rgb.clone()
    assert depth is not None
    far = slice(0, SIZE // 2)
    depth = depth.clone()
    depth[:, far] = torch.where(depth[:, far] > 0, 3 * depth[:, far], 0)
    rgb[:, far] = torch.rand((SIZE, SIZE // 2, 3), generator=torch.Generator().manual_seed(0))
    found = found_for(replace(view, frame=replace(view.frame, depth=depth, rgb=rgb)), replace(QUICK, rounds=1))
    assert "on an occluder" not in found.reason
