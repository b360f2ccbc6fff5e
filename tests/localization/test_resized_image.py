"""Images resized to another aspect ratio, and images of other cameras that only look as if they were."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import pytest
import torch

from bidnerf_core import Intrinsics
from bidnerf_core.camera import exposure_times, moved_points
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import LandmarkMatcher, LandmarkPose, landmark_verdict, propose
from bidnerf_core.mapping import LandmarkMap, build_landmarks
from bidnerf_core.results import pose_error
from landmark_scene import PINHOLE, Points, looking_in, ring

POINTS = Points(noise=0.3)
POSES = [looking_in(0.43, 0.45, 3.6), looking_in(2.5, 0.6, 4.0)]


@pytest.fixture(scope="module")
def landmarks() -> LandmarkMap:
    built = build_landmarks(ring(POINTS), POINTS)
    scatter = torch.full((4,), 3e-3, dtype=torch.float64)
    return replace(built, cameras=(PINHOLE,), correlation=4.0, calibration_scatter=scatter)


def found_with(landmarks: LandmarkMap, view: View, stated: Intrinsics) -> LandmarkPose:
    view = replace(view, frame=replace(view.frame, intrinsics=stated))
    found = propose(LandmarkMatcher(landmarks), [view], POINTS)
    assert found is not None
    return found


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("across", [0.75, 0.95, 0.97, 1.03, 1.05, 1.33])
def test_an_image_of_the_maps_camera_that_was_resized_is_recognised(
    landmarks: LandmarkMap, across: float, pose: SE3
) -> None:
    """Motions between the rows, focal lengths and other poses explain stretches of 3 and 5 % nearly as well."""
    stated = replace(PINHOLE, fx=PINHOLE.fx / across)
    found = found_with(landmarks, POINTS.view(pose, PINHOLE), stated)
    assert landmark_verdict(found).accepted
    assert found.intrinsics == PINHOLE
    assert not found.has_motion
    error = pose_error(found.T_world_camera, pose)
    assert error.translation < 0.01
    assert error.rotation_deg < 0.1


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize(("rows", "columns"), [(14, 0), (24, 0), (0, 20), (0, 32), (120, 0)])
def test_an_image_of_another_aspect_ratio_keeps_its_own_intrinsics(
    landmarks: LandmarkMap, rows: int, columns: int, pose: SE3
) -> None:
    """The middle of an image with the right camera: resized to it, the map's camera has pixels that are not square."""
    part = replace(
        PINHOLE,
        width=PINHOLE.width - columns,
        height=PINHOLE.height - rows,
        cx=PINHOLE.cx - columns / 2,
        cy=PINHOLE.cy - rows / 2,
    )
    found = found_with(landmarks, POINTS.view(pose, part), part)
    assert landmark_verdict(found).accepted
    assert found.intrinsics_of(part) is None
    assert pose_error(found.T_world_camera, pose).translation < 0.01


def moving_points(pose: SE3, camera: Intrinsics, motion: torch.Tensor) -> Points:
    """Return the points where a camera at rest sees them as a moving one sees the given ones."""
    local = pose.inverse().apply(POINTS.positions)
    times = exposure_times(camera.project(local), camera)
    points = copy(POINTS)  # which shares the list of what was seen
    points.positions = pose.apply(moved_points(local, times, motion))
    return points


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("across", [0.95, 1.05])
def test_evidence_favours_the_true_camera(
    landmarks: LandmarkMap, across: float, pose: SE3, moved: bool
) -> None:
    """An image is resized, or of another camera for which the other hypothesis is the map's; the true camera may have moved."""
    stated = replace(PINHOLE, fx=PINHOLE.fx / across)
    motion = torch.tensor([0.0, 0.01, 0.0, 0.0, 0.0, 0.012], dtype=torch.float64) * float(moved)
    for true in (PINHOLE, stated):
        found = found_with(landmarks, moving_points(pose, true, motion).view(pose, true), stated)
        assert found.takes_map_camera is (true is PINHOLE)
        assert found.guided is not None
        taken = found.guided.posterior.best.hypothesis.group
        weighted = zip(found.guided.posterior.explanations, found.guided.posterior.probabilities, strict=True)
        assert sum(p for each, p in weighted if each.hypothesis.group == taken) > 0.85


def test_the_doubt_between_two_cameras_is_part_of_the_covariance(landmarks: LandmarkMap) -> None:
    """The evidence is weak if keypoints count for little, and the covariance then covers both hypotheses."""
    pose = POSES[0]
    view, stated = POINTS.view(pose, PINHOLE), replace(PINHOLE, fx=PINHOLE.fx / 1.05)
    vague = replace(landmarks, correlation=1000.0)
    found = found_with(vague, view, stated)
    assert not found.takes_map_camera
    off = (found.T_world_camera.inverse() @ pose).log()
    assert float(torch.linalg.eigvalsh(found.doubt.covariance)[-1]) > 0.01 * float(off @ off)


def test_a_map_that_does_not_know_its_cameras_takes_the_given_one(landmarks: LandmarkMap) -> None:
    stated = replace(PINHOLE, fx=PINHOLE.fx / 1.33)
    found = found_with(replace(landmarks, cameras=()), POINTS.view(POSES[0], PINHOLE), stated)
    assert not found.takes_map_camera
