"""Poses of images whose rows were exposed one after the other, while the camera turned."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core import Localizer, View
from bidnerf_core.evaluation import rolling_shutter
from bidnerf_core.frames import observe
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import AutoConfig, LandmarkMatcher, LandmarkPose, propose
from bidnerf_core.results import normalized_error_squared, pose_error
from bidnerf_core.testing import textured_map, unseen
from conditions import ground_landmarks
from localizations import CHI2_99

TRUTH = unseen().T_ref_camera
LANDMARKS = replace(ground_landmarks(), cameras=())


def photo(degrees: float = 0.0, seed: int = 0, depth: bool = False) -> View:
    """Return an image that was taken while the camera turned by so many degrees from the first row to the last."""
    view = unseen()
    frame = rolling_shutter(view.frame, degrees, torch.Generator().manual_seed(seed))
    return replace(view, frame=frame if depth else replace(frame, depth=None))


def found(*views: View, moving: bool = True) -> LandmarkPose:
    pose = propose(LandmarkMatcher(LANDMARKS), views, moving=moving)
    assert pose is not None
    return pose


def off(pose: LandmarkPose) -> float:
    """Return the error of a pose in degrees."""
    return float(pose_error(pose.T_world_camera, TRUTH).rotation_deg)


@pytest.mark.parametrize("seed", range(2))
def test_the_motion_is_estimated_and_hardly_shifts_the_pose_any_longer(seed: int) -> None:
    view = photo(2.0, seed)
    pose, taken_as_still = found(view), found(view, moving=False)
    assert pose.has_motion
    assert not taken_as_still.has_motion
    assert off(pose) < 0.6 * off(taken_as_still)
    assert pose.noise < taken_as_still.noise
    assert float(normalized_error_squared(pose.T_world_camera, TRUTH, pose.full_covariance)) < CHI2_99
    assert (
        float(normalized_error_squared(taken_as_still.T_world_camera, TRUTH, taken_as_still.full_covariance))
        > CHI2_99
    )


def test_an_image_that_was_exposed_at_once_shows_no_motion() -> None:
    assert not found(photo()).has_motion


def test_views_of_a_rig_are_taken_as_still() -> None:
    assert not found(photo(2.0), photo(2.0)).has_motion


@pytest.mark.parametrize(("depth", "seed"), [(True, 1), (False, 2)], ids=["RGB-D", "RGB"])
def test_fusion_does_not_put_back_what_the_motion_has_removed(depth: bool, seed: int) -> None:
    stored = replace(textured_map(surface=True), landmarks=LANDMARKS)
    view = photo(2.0, seed, depth)
    answer, alone = Localizer(stored, config=AutoConfig(fused_rays=256))(view.frame), found(view)
    assert answer.converged
    assert "fused with " + ("depth" if depth else "rendering") in answer.reason
    assert answer.covariance is not None
    by_landmarks = float(normalized_error_squared(alone.T_world_camera, TRUTH, alone.full_covariance))
    assert float(normalized_error_squared(answer.T_world_camera, TRUTH, answer.covariance)) < 3 * by_landmarks
    assert "rolling shutter" in answer.reason


def test_rays_of_a_moving_view_start_where_the_camera_was_at_their_rows() -> None:
    view = unseen()
    camera = view.frame.intrinsics
    motion = torch.tensor([0.02, -0.01, 0.03, 0.01, 0.03, -0.02], dtype=torch.float64)
    pixels = torch.tensor([[10, 0], [10, camera.height // 2], [30, camera.height - 1]])
    found = observe(replace(view, motion=motion), pixels, torch.float64)
    for number, (_, row) in enumerate(pixels.tolist()):
        moment = (row + 0.5) / camera.height - 0.5
        there = replace(view, T_ref_camera=TRUTH @ SE3.exp(moment * motion))
        expected = observe(there, pixels[number : number + 1], torch.float64)
        torch.testing.assert_close(found.origins[number], expected.origins[0])
        torch.testing.assert_close(found.points[number], expected.points[0])
