"""Captures by moving cameras with rolling shutters: how it is noticed, what is estimated, and what training makes of it."""

from __future__ import annotations

import functools
from dataclasses import replace
from math import degrees
from statistics import median
from typing import Any

import pytest
import torch
from torch import Tensor

from bidnerf import SE3, Frame, View
from bidnerf.testing import BOUNDS, GROUND_CAMERA, POSES, ground
from bidnerf_core.camera import STILL

# Inside: the evidence of a common motion, of which a capture only shows the decision
from bidnerf_core.captures import (
    PoseRefinement,
    TrainingPoses,
    apply_stored_poses,
    given_cameras,
    moved_cameras,
    pose_sentences,
    stored_cameras,
    training_views,
    tried_landmarks,
)
from bidnerf_core.captures.cameras import record_refinement
from bidnerf_core.captures.training_views import common_motion, training_poses
from bidnerf_core.fields import render, render_image
from bidnerf_core.frames import all_pixels, observe
from bidnerf_core.localization import LandmarkMatcher, Loop
from bidnerf_core.mapping import (
    LandmarkConfig,
    TrackedViews,
    landmark_tensors,
    landmarks_from_tensors,
    pose_updates,
    track_views,
)
from inaccurate_captures import VIEWS, capture, turned, updates
from landmark_scene import PINHOLE, Points, looking_in
from optional import require

NOISE = 0.3
METRES, RADIANS = 0.01, 0.008  # what a hand does in a few hundredths of a second: about three pixels


def motions(scale: float) -> Tensor:
    return updates(scale * METRES, scale * RADIANS, seed=4)


def moving(scale: float, pose_error: float = 0.0) -> tuple[Points, list[View], SE3]:
    """Views of a ring of cameras that moved, with errors of the given poses (metres, and as many radians), and the true ones."""
    return capture(NOISE, updates(pose_error, pose_error, seed=3), motions(scale))


@functools.cache
def tracks(scale: float, pose_error: float = 0.0) -> tuple[TrackedViews, list[View], SE3]:
    points, views, true = moving(scale, pose_error)
    return track_views(views, points), views, true


@functools.cache
def corrected(scale: float, pose_error: float = 0.004) -> tuple[TrainingPoses, list[View], SE3]:
    tracked, views, true = tracks(scale, pose_error)
    return training_poses(tracked, views), views, true


def evidence_prior(tracked: TrackedViews) -> object:
    return common_motion(*tracked.triangulate(LandmarkConfig()), 1.0)


def test_cameras_that_moved_are_distinguished_from_those_at_rest() -> None:
    for scale, expected in ((0.0, True), (1.0, False)):
        assert (evidence_prior(tracks(scale)[0]) == STILL) == expected


def test_one_image_is_no_evidence_against_all_others() -> None:
    moved = torch.zeros(VIEWS, 6, dtype=torch.float64)
    moved[5] = 3 * motions(1.0)[5]
    points, views, _ = capture(NOISE, torch.zeros_like(moved), moved)
    assert evidence_prior(track_views(views, points)) == STILL


def test_few_images_are_no_evidence() -> None:
    points, views, _ = moving(1.0)
    assert evidence_prior(track_views(views[:5], points)) == STILL


def test_motions_are_estimated_and_the_poses_become_more_accurate() -> None:
    found, views, poses = corrected(1.0)
    assert found.refined
    assert require(found.consistency).noise_after == pytest.approx(NOISE, rel=0.15)
    # Where each camera sees each point in its last row, pixels: translation and rotation may make up for each other.
    true, estimated, none = (
        PINHOLE.project((poses @ SE3.exp(0.5 * motion))[:, None].inverse().apply(Points().positions))
        for motion in (motions(1.0), found.tracked.observations.motion, motions(0.0))
    )
    assert float((estimated - true).norm(dim=-1).median()) < 0.35 * float((true - none).norm(dim=-1).median())
    given = SE3.stack([view.T_ref_camera for view in views])
    assert float(turned(found.tracked.T_world_camera, poses).median()) < 0.5 * float(turned(given, poses).median())


def test_motions_are_noticed_though_the_poses_are_right() -> None:
    """Structure from motion gives such poses for the frames of a video; the keypoints alone contradict a camera at rest."""
    found, _, _ = corrected(1.0, pose_error=0.0)
    assert found.refined
    assert bool((found.tracked.observations.motion != 0).any())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "pose_error"),
    [
        ({"fy": 1.05 * PINHOLE.fy}, 0.004),
        ({"cx": PINHOLE.cx + 10}, 0.004),
        ({"distortion": (0.2, 0, 0, 0)}, 0.0),
    ],
)
def test_wrong_intrinsics_are_no_motion(wrong: dict[str, Any], pose_error: float) -> None:
    points, views, _ = moving(0.0, pose_error)
    camera = replace(PINHOLE, **wrong)
    views = [replace(view, frame=replace(view.frame, intrinsics=camera)) for view in views]
    found = training_poses(track_views(views, points), views)
    assert bool((found.tracked.observations.motion == 0).all())


def test_known_motions_leave_only_the_noise_of_keypoints() -> None:
    """What is built from the same tracks, landmarks and the scatter of poses, takes the motions into account."""
    tracked, _, true = tracks(1.0)
    seen, positions = tracked.at(true, motions(1.0)).triangulate(LandmarkConfig())
    blind, elsewhere = tracked.triangulate(LandmarkConfig())
    off, before = (
        torch.stack([update[3:].norm() for update in pose_updates(*pair).values()]).median()
        for pair in ((seen, positions), (blind, elsewhere))
    )
    assert len(seen.point) > len(blind.point)
    assert float(off) < 0.5 * float(before)


def test_views_with_a_motion_are_tracked_with_it() -> None:
    points, views, _ = moving(1.0)
    moved = motions(1.0)[:4]
    known = [replace(view, motion=motion) for view, motion in zip(views[:4], moved, strict=True)]
    assert torch.equal(track_views(known, points).observations.motion, moved)


def test_stored_cameras_have_both_poses_the_distance_between_them_and_the_motion() -> None:
    found, views, _ = corrected(1.0)
    poses, moved = found.tracked.T_world_camera, found.tracked.observations.motion
    trained = [replace(v, T_ref_camera=poses[i], motion=moved[i]) for i, v in enumerate(views)]
    cameras = record_refinement(views, stored_cameras(trained), found.pixels.tolist())
    assert given_cameras(cameras) == stored_cameras(views)
    for one, other in zip(apply_stored_poses(views, cameras), trained, strict=True):
        assert torch.equal(one.T_ref_camera.matrix(), other.T_ref_camera.matrix())
        assert torch.equal(require(one.motion), require(other.motion))
    others = apply_stored_poses(trained, cameras)  # other poses than the dataset's are those of another dataset
    assert all(a.T_ref_camera is b.T_ref_camera for a, b in zip(others, trained, strict=True))
    update = (views[3].T_ref_camera.inverse() @ poses[3]).log()
    camera = moved_cameras(cameras)[3]
    assert camera.name == views[3].frame.name
    assert camera.translation == pytest.approx(float(update[:3].norm()))
    assert camera.rotation_deg == pytest.approx(float(update[3:].norm().rad2deg()))
    noise = require(found.consistency)
    first, second = pose_sentences(cameras, PoseRefinement(noise.noise_before, noise.noise_after, True))
    worst = max(range(VIEWS), key=lambda i: float(found.pixels[i]))
    assert f"most for {views[worst].frame.name} by" in first
    assert "rolling shutter" in second
    metres, radians = (median(moved[:, part].norm(dim=-1).tolist()) for part in (slice(3), slice(3, 6)))
    assert f"by {metres:.2g} and {degrees(radians):.2g}°" in second


@pytest.mark.slow
def test_training_gets_the_motions(monkeypatch: pytest.MonkeyPatch) -> None:
    points, views, _ = moving(1.0, 0.004)
    monkeypatch.setattr(
        training_views, "track_views", lambda given, _, **options: track_views(given, points, **options)
    )
    found = training_views.prepare_views(views)
    moved = [view.motion is not None and bool(view.motion.any()) for view in found.views]
    assert sum(moved) >= VIEWS - 1  # an image whose keypoints are all left out keeps its pose
    assert [camera.motion is not None and any(camera.motion) for camera in found.cameras] == moved
    assert stored_cameras(views) != found.cameras


def test_an_image_is_rendered_row_by_row() -> None:
    motion, camera = motions(2.0)[1], GROUND_CAMERA.scaled(0.25)
    frame = Frame("small", torch.zeros(camera.height, camera.width, 3), camera)
    view = View(frame, POSES[1])
    image = render_image(ground(), camera, view.T_ref_camera, BOUNDS, motion=motion)
    rays = observe(replace(view, motion=motion), all_pixels(view.frame))
    rendered = render(ground(), BOUNDS.rays(rays.origins, rays.directions), BOUNDS.background)
    expected = rendered.rgb.clamp(0, 1).reshape_as(image.rgb)
    torch.testing.assert_close(image.rgb, expected, rtol=0, atol=1e-3)
    at_rest = render_image(ground(), camera, view.T_ref_camera, BOUNDS)
    assert float((image.rgb - at_rest.rgb).abs().max()) > 0.1
    zero = render_image(ground(), camera, view.T_ref_camera, BOUNDS, motion=torch.zeros(6).double())
    assert torch.equal(zero.rgb, at_rest.rgb)


def test_the_columns_of_a_portrait_image_are_the_rows_of_its_sensor() -> None:
    upright = replace(PINHOLE, cx=PINHOLE.cy, cy=PINHOLE.cx, width=PINHOLE.height, height=PINHOLE.width)
    points = Points(noise=NOISE)
    moved = motions(1.0)
    views = [points.view(looking_in(0.105 * i, 0.3 * (i % 3)), upright, seed=i, motion=moved[i]) for i in range(VIEWS)]
    assert evidence_prior(track_views(views, points)) != STILL


@pytest.mark.slow
def test_a_trial_finds_the_motions_that_the_map_knows() -> None:
    """If it took the images of moving cameras as still, their keypoints would seem to have large common errors."""
    count = 24
    points, moved = Points(noise=NOISE), motions(2.0).repeat(2, 1)
    poses = [looking_in(0.105 * i, 0.3 * (i % 3)) for i in range(count)]
    seen = [points.view(T, seed=i, motion=moved[i]) for i, T in enumerate(poses)]
    views = [replace(view, motion=motion) for view, motion in zip(seen, moved, strict=False)]
    landmarks = tried_landmarks(track_views(views, points), views)
    assert landmarks.trial.found == 8
    assert landmarks.trial.rotation_deg < 0.08
    assert landmarks.correlation < 5


def test_landmarks_tell_how_many_of_their_images_moved() -> None:
    moved = motions(1.0)
    moved[:4] = 0
    tracked, _, true = tracks(1.0)
    landmarks = tracked.at(true, moved).landmarks(LandmarkConfig())
    assert landmarks.moving == 0.75
    assert landmarks_from_tensors(landmark_tensors(landmarks)).moving == 0.75


def test_slow_motions_are_taken_from_queries_of_a_moving_map() -> None:
    points, views, true = moving(
        0.4
    )  # slower ones are as small as the motions that landmarks suggest of cameras at rest
    landmarks = track_views(views, points).at(true, motions(0.4)).landmarks(LandmarkConfig())
    seen = {}
    for share in (0.0, 1.0):
        matcher = LandmarkMatcher(replace(landmarks, correlation=1.0, moving=share))
        found = [Loop([View(v.frame, SE3.identity())], matcher, features=points)() for v in views]
        assert all(answer is not None for answer in found)
        seen[share] = sum(answer is not None and answer.explanation[1] for answer in found)
    assert seen[1.0] > seen[0.0] > 0
