"""Refinement of training poses: known errors are taken back, right poses stay, and a wrong one is found and put right."""

from __future__ import annotations

import functools
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from bidnerf import SE3, Frame, Intrinsics, View
from bidnerf_core.captures import (
    PoseRefinement,
    TrainingPoses,
    moved_cameras,
    pose_sentences,
    stored_cameras,
)

# Inside: how far each pose was refined, and the checks of poses and depth that precede a training
from bidnerf_core.captures.cameras import record_refinement
from bidnerf_core.captures.training_views import adjust_poses, check_depth_unit, prepare_views, training_poses
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.mapping import LandmarkConfig, Sift, TrackedViews, track_views
from inaccurate_captures import VIEWS, refined, turned, updates
from landmark_scene import Points, looking_in, ring
from optional import require

WRONG = 7
METRES, RADIANS = 0.01, 0.004  # together about two pixels


NOTHING = torch.zeros(VIEWS, 6, dtype=torch.float64)


def errors(scale: float = 1.0) -> Tensor:
    return updates(scale * METRES, scale * RADIANS, seed=3)


@functools.cache
def inaccurate() -> tuple[TrainingPoses, list[View], SE3]:
    return refined(0.4, errors())


def test_exact_poses_do_not_move_at_all() -> None:
    found, views, _ = refined(0.0, NOTHING, least=0.0)
    moved = torch.cat([(found.tracked.T_world_camera[i].inverse() @ v.T_ref_camera).log() for i, v in enumerate(views)])
    assert float(moved.abs().max()) < 1e-5  # the keypoints are float32
    assert require(found.consistency).inconsistency == pytest.approx(0, abs=1e-3)


def test_poses_that_fit_are_kept() -> None:
    found, views, _ = refined(0.4, NOTHING)
    assert not found.refined
    assert found.replaced == []
    for i, view in enumerate(views):
        assert torch.equal(found.tracked.T_world_camera[i].matrix(), view.T_ref_camera.matrix())
    assert require(found.consistency).inconsistency < 0.15


def test_known_errors_are_taken_back() -> None:
    found, views, true = inaccurate()
    given = SE3.stack([view.T_ref_camera for view in views])
    assert found.refined
    assert require(found.consistency).inconsistency > 0.5
    assert require(found.consistency).noise_after == pytest.approx(0.4, rel=0.2)
    assert float(turned(found.tracked.T_world_camera, true).median()) < 0.4 * float(turned(given, true).median())
    assert 0.5 < float(found.pixels.median()) < 4
    motion = found.tracked.T_world_camera.translation - given.translation
    assert float(motion.mean(0).norm()) < 0.2 * float(motion.norm(dim=-1).median())


@pytest.mark.parametrize("turn", [0.2, torch.pi])
def test_a_wrong_pose_is_put_right_and_the_others_are_kept(turn: float) -> None:
    off = NOTHING.clone()
    off[WRONG] = torch.tensor([0.3, -0.1, 0.2, 0.0, 0.0, turn], dtype=torch.float64)
    found, _, true = refined(0.4, off)
    assert found.replaced == [WRONG]
    assert not found.refined
    # A matching from scratch, as of a resumed training, gives the same tracks.
    again = replace(found.tracked, matches={}).rematch(LandmarkConfig(), *found.tracked.triangulate(LandmarkConfig()))
    assert torch.equal(found.tracked.observations.point, again.observations.point)
    poses = found.tracked.T_world_camera
    translation, rotation = (true[WRONG].inverse() @ poses[WRONG]).log().split(3)
    assert float(translation.norm()) < 0.02
    assert float(rotation.norm()) < 0.005
    assert float(found.pixels[WRONG]) > 20
    kept = [i for i in range(VIEWS) if i != WRONG]
    assert torch.equal(poses[kept].matrix(), true[kept].matrix())
    assert float(found.pixels[kept].max()) == 0


def test_a_wrong_pose_among_inaccurate_ones() -> None:
    off = errors(0.5)
    off[WRONG] = torch.tensor([0.3, -0.1, 0.2, 0.0, 0.2, 0.0], dtype=torch.float64)
    found, _, true = refined(0.4, off)
    assert found.replaced == [WRONG]
    assert found.refined
    assert float((true[WRONG].inverse() @ found.tracked.T_world_camera[WRONG]).log()[:3].norm()) < 0.04


def test_too_few_images_are_left_alone() -> None:
    points = Points()
    views = ring(points, 3)
    tracked = track_views(views, points)
    assert adjust_poses(tracked) is None
    found = training_poses(tracked, views)
    assert (found.refined, found.consistency, found.replaced) == (False, None, [])


def test_nothing_in_common_leaves_the_poses_alone() -> None:
    points = Points()
    views = [points.view(looking_in(0.1 * i)) for i in range(12)]
    named = torch.tensor([12, 0, 0], dtype=torch.uint8)
    blank = [replace(view, frame=view.frame.replace(rgb=named.expand_as(view.frame.rgb_bytes))) for view in views]
    points.seen.append(points.seen[0][torch.zeros(0, dtype=torch.long)])
    found = training_poses(track_views(blank, points), blank)
    assert (found.refined, found.consistency, found.replaced) == (False, None, [])


@pytest.mark.parametrize("count", [7, 60, 61, 130])
def test_poses_that_are_not_refined_are_checked_by_at_most_sixty_views(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = Frame("a", torch.zeros(3, 4, 3), Intrinsics(4.0, 4.0, 2.0, 1.5, 4, 3), torch.ones(3, 4))
    checked = list[View]()
    module = "bidnerf_core.captures.training_views"
    monkeypatch.setattr(f"{module}.detect_keypoints", lambda views, _: checked.extend(views) or [])
    prepare_views([View(frame, looking_in(0.01 * i)) for i in range(count)], "never")
    assert min(count, 30) <= len(checked) <= 60


def test_cameras_that_did_not_move_have_one_pose() -> None:
    views = ring(Points(), 4)
    cameras = record_refinement(views, stored_cameras(views), [0.0] * 4)
    assert cameras == stored_cameras(views)
    assert moved_cameras(cameras) == []
    (line,) = pose_sentences(cameras, PoseRefinement(0.3, 0.3, True))
    assert line.endswith("the poses are kept")


# Recorded scenes


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("scene", "refined"), [("room_living", False), ("tum_fr1_xyz", True)])
def test_poses_of_motion_capture_are_refined_and_those_of_a_renderer_are_not(
    data_dir: Path, scene: str, refined: bool
) -> None:
    dataset = open_dataset(data_dir / scene)
    views = dataset.views("train", dataset.frame_names("train")[:12])
    found = training_poses(track_views(views, Sift(count=300)), views)
    assert found.refined == refined
    noise = require(found.consistency)
    if refined:
        assert noise.noise_after < 0.7 * noise.noise_before
        assert 0.3 < float(found.pixels.median()) < 2
    else:
        assert noise.inconsistency < 0.1


def measured(ratio: float) -> TrackedViews:
    """Images whose measured depth is ``ratio`` times the true one."""
    points = Points(noise=0.3)
    return track_views(ring(points, 8, depth=ratio), points)


@pytest.mark.parametrize("ratio", [1000.0, 0.001, 0.3048])
def test_depth_in_another_unit_is_refused(ratio: float) -> None:
    with pytest.raises(InputError, match=r"times the depth that the poses .*depth_unit_scale_factor"):
        check_depth_unit(measured(ratio))


def test_another_unit_of_depth_is_named_where_it_can_be_given() -> None:
    for ratio, unit, better in ((0.2, 1 / 5000, "0.001"), (0.198, 1 / 5000, "0.001"), (0.3048, 0.001, "0.00328")):
        with pytest.raises(InputError, match=rf"times .*`depth_unit` {re.escape(better)}, "):
            check_depth_unit(measured(ratio), unit)


@pytest.mark.parametrize(("ratio", "said"), [(1.08, True), (0.94, True), (1.02, False)])
def test_a_scale_of_depth_that_is_a_few_percent_wrong_is_logged(
    ratio: float, said: bool, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "bidnerf")
    check_depth_unit(measured(ratio))
    assert ("times the depth that the poses and photos imply; training takes both" in caplog.text) == said
