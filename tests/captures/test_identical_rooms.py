"""Two rooms that look the same: exact poses stay, a wrong one is found, and no photo is accepted in the wrong room."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bidnerf import SE3, View
from bidnerf_core.captures import TrainingPoses, pose_contradiction, survey_capture

# Inside: the choice of poses is tested without a training around it
from bidnerf_core.captures.training_views import training_poses
from bidnerf_core.localization import LandmarkMatcher, Loop, Outcome
from bidnerf_core.mapping import DEFAULT_LANDMARKS, detect_keypoints, track_views
from landmark_scene import Points, looking_in
from optional import require

EACH = 20
AWAY = torch.tensor([6.0, 0.0, 0.0], dtype=torch.float64)
WRONG = torch.tensor([4.0, 2.0, 4.0, 0.0, 0.7, 0.0], dtype=torch.float64)  # 6 m and 40 degrees


def moved(T: SE3, by: Tensor) -> SE3:
    return SE3(T.rotation, T.translation + by)


def capture(rooms: int, wrong: int | None = None) -> tuple[Points, list[View], list[SE3]]:
    """Photos of as many copies of the points, each from all sides and from places of its own, and their true poses."""
    points, views, poses = Points(150, 0.3), list[View](), list[SE3]()
    for number in range(rooms * EACH):
        room, i = divmod(number, EACH)
        T = looking_in(0.315 * i + 0.08 * room, 0.3 * (i % 3) + 0.12 * room, 4.0 - 0.35 * room)
        poses.append(moved(T, room * AWAY))
        given = poses[-1].retract(WRONG) if number == wrong else poses[-1]
        view = points.view(T, T_ref_camera=given, seed=number)
        views.append(replace(view, frame=replace(view.frame, name=f"{number}")))
    return points, views, poses


@functools.cache
def trained(rooms: int, wrong: int | None = None) -> tuple[TrainingPoses, Points, list[View], list[SE3]]:
    points, views, poses = capture(rooms, wrong)
    return training_poses(track_views(views, points), views), points, views, poses


def test_exact_poses_in_identical_rooms_stay() -> None:
    found, _, views, poses = trained(2)
    assert (found.replaced, found.refined) == ([], False)
    assert torch.equal(found.tracked.T_world_camera.matrix(), SE3.stack(poses).matrix())
    report = survey_capture(found.tracked, views)
    assert not {"badly posed", "turned", "isolated"} & {each for photo in report.photos for each in photo.problems}


def test_the_order_of_the_photos_does_not_matter() -> None:
    """Successive photos of different rooms look alike, but their exact poses contradict none in their own room."""
    points, views, _ = capture(2)
    mixed = [views[EACH * (i % 2) + i // 2] for i in range(2 * EACH)]
    assert pose_contradiction(detect_keypoints(mixed, points)) is None


def test_a_photo_of_either_room_is_not_accepted_in_the_other() -> None:
    found, points, _, _ = trained(2)
    matcher = LandmarkMatcher(found.tracked.landmarks(DEFAULT_LANDMARKS))
    for number in range(6):
        query = points.view(looking_in(1.0 * number + 0.1, 0.2, 3.8), seed=number)
        answer = require(Loop([query], matcher, features=points)())
        assert answer.verdict.outcome is Outcome.AMBIGUOUS
        here, there = (answer.posterior.place(mode).translation for mode in (0, 1))
        assert float((here - there).norm()) == pytest.approx(float(AWAY.norm()), abs=0.05)


@pytest.mark.parametrize(("rooms", "wrong"), [(1, 7), (2, 27)])
def test_a_wrong_pose_is_found_and_no_other_photo_is_moved(rooms: int, wrong: int) -> None:
    """In which of two identical rooms a photo was taken does not show in it: either is a repair."""
    found, _, _, poses = trained(rooms, wrong)
    assert found.replaced == [wrong]
    T = found.tracked.T_world_camera
    others = [i for i in range(len(poses)) if i != wrong]
    assert torch.equal(T[others].matrix(), SE3.stack(poses)[others].matrix())
    room = wrong // EACH
    copies = [moved(poses[wrong], (k - room) * AWAY) for k in range(rooms)]
    off = min(((copy.inverse() @ T[wrong]).log() for copy in copies), key=lambda update: float(update.norm()))
    assert float(off[:3].norm()) < 0.02
    assert float(off[3:].norm()) < 0.005
