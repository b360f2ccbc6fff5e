"""Cropped and stretched images: told from the matches that a pose leaves out, localized where they are the map camera's or cropped."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest
import torch
from torch import Generator

from bidnerf_core import Frame, Localization, Outcome, View
from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import (
    AutoConfig,
    LandmarkMatcher,
    LandmarkPose,
    landmark_verdict,
    propose,
    rig,
)
from bidnerf_core.localization.landmarks.consensus import Candidate
from bidnerf_core.localization.landmarks.far_cameras import UNSUSPECTED, camera_fit
from bidnerf_core.mapping import GIVEN, Calibration, ObservedPoints, build_landmarks
from bidnerf_core.results import pose_error
from bidnerf_core.testing import CAMERA, textured_map, training_views, unseen
from landmark_scene import PINHOLE, Points, looking_in, ring
from problems import localize

FOCAL = 500.0
LIMIT = 2.0
TRUTH = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.1, 0.2, -0.1], dtype=torch.float64))


def matches(
    generator: Generator,
    across: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
    count: int = 200,
    wrong: int = 40,
) -> ObservedPoints:
    """Return points before the camera, seen in an image stretched ``across`` and moved by a ``shift``, some matched wrongly."""
    local = torch.rand((count, 3), generator=generator, dtype=torch.float64) * 2 - 1
    local[:, 2] += 4
    image = local[:, :2] / local[:, 2:] * torch.tensor([across, 1.0]) + torch.tensor(shift)
    image = image + 0.3 / FOCAL * torch.randn((count, 2), generator=generator, dtype=torch.float64)
    image[:wrong] = torch.rand((wrong, 2), generator=generator, dtype=torch.float64) * 0.5 - 0.25
    each = torch.ones(count, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    sight = torch.nn.functional.normalize(TRUTH.rotate(local), dim=-1)
    return ObservedPoints(
        TRUTH.apply(local), 1e-3 * torch.ones((count, 2), dtype=torch.float64), sight, image, FOCAL * each,
        0 * each, eye, torch.zeros((count, 3), dtype=torch.float64), 0 * each,
    )  # fmt: skip


def agreeing(data: ObservedPoints, T: SE3) -> int:
    return int((torch.linalg.vector_norm(data.residuals(T), dim=-1) <= LIMIT).sum())


def fitted(data: ObservedPoints, start: SE3 = TRUTH) -> Candidate:
    found = camera_fit(data, start, GIVEN, LIMIT)
    assert found is not None
    return found


@pytest.mark.parametrize("across", [0.6, 0.9, 1.1, 1.5])
def test_a_stretch_is_estimated_from_a_pose_that_few_matches_agree_with(
    across: float, generator: Generator
) -> None:
    """The focal length down is as given, so that all of the change is across."""
    found = fitted(matches(generator, across))
    wide, high = found.calibration.across_and_down.tolist()
    assert wide / high == pytest.approx(across, rel=0.01)
    assert high == pytest.approx(1, abs=0.03)
    assert pose_error(found.T_world_rig, TRUTH).translation < 0.1


@pytest.mark.parametrize("shift", [(-0.15, 0.0), (0.1, 0.08), (0.0, -0.2)])
def test_a_part_of_an_image_is_told_from_its_principal_point(
    shift: tuple[float, float], generator: Generator
) -> None:
    """The start is turned by as much as the principal point is off, as a pose is that takes the middle of the part for it."""
    turn = torch.tensor([0.0, 0.0, 0.0, shift[1], -shift[0], 0.0], dtype=torch.float64)
    data, start = matches(generator, shift=shift), TRUTH.retract(turn)
    assert pose_error(start, TRUTH).rotation_deg > 5
    found = fitted(data, start)
    assert not found.calibration.is_stretched
    assert (found.calibration.shift_u, found.calibration.shift_v) == pytest.approx(shift, abs=0.03)
    assert pose_error(found.T_world_rig, TRUTH).rotation_deg < 2
    given = Intrinsics(FOCAL, FOCAL, 320.0, 240.0, 640, 480)
    camera = found.calibration.applied(given)
    assert (camera.cx - 320, camera.cy - 240) == pytest.approx((FOCAL * shift[0], FOCAL * shift[1]), abs=15)


def test_the_right_camera_is_not_suspected(generator: Generator) -> None:
    """Also where fewer matches agree than would leave it unsuspected."""
    for wrong in (45, 80, 120):
        data = matches(generator, wrong=wrong)
        assert agreeing(data, TRUTH) < UNSUSPECTED * len(data)
        assert camera_fit(data, TRUTH, GIVEN, LIMIT) is None


def test_garbage_has_no_camera_and_does_no_harm(generator: Generator) -> None:
    """Points at, behind and far beyond the camera, matched at random."""
    data = matches(generator, wrong=200)
    odd = data.points.clone()
    odd[::4], odd[1::4] = TRUTH.translation, 1e12 * odd[1::4]
    odd[2::4] = TRUTH.apply(torch.tensor([0.3, 0.1, 1e-300], dtype=torch.float64))
    assert camera_fit(replace(data, points=odd), TRUTH, GIVEN, LIMIT) is None


def test_a_pose_that_most_matches_agree_with_is_not_questioned(generator: Generator) -> None:
    """A pose that none agrees with is not questioned either, since it leads nowhere."""
    data = matches(generator, shift=(0.002, 0.0), wrong=0)
    assert agreeing(data, TRUTH) > UNSUSPECTED * len(data)
    assert camera_fit(data, TRUTH, GIVEN, LIMIT) is None
    assert camera_fit(matches(generator, shift=(0.5, 0.0), wrong=0), TRUTH, GIVEN, LIMIT) is None


def test_intrinsics_of_a_stretch_and_a_correction_project_as_their_fit_says() -> None:
    """x = (factor X/Z) stretched across plus the shift, in units of the given focal length."""
    given = Intrinsics(400.0, 400.0, 320.0, 240.0, 640, 480)
    calibration = Calibration(0.05, 0.1, -0.06, log_stretch=math.log(1.2))
    camera = calibration.applied(given)
    point = torch.tensor([[0.3, -0.2, 1.5]], dtype=torch.float64)
    u, v = camera.project(point)[0].tolist()
    factor = calibration.focal_factor
    assert u == pytest.approx(320 + 400 * (0.2 * 1.2**0.5 * factor + 0.1))
    assert v == pytest.approx(240 + 400 * (-0.2 / 1.5 / 1.2**0.5 * factor - 0.06))
    flat = calibration.pixels(point[:, :2] / point[:, 2:], 400.0)[0]
    assert (flat + torch.tensor([320.0, 240.0])).tolist() == pytest.approx([u, v])


def test_a_focal_length_far_off_is_found_from_few_agreeing_matches(generator: Generator) -> None:
    """Few matches agree with the start by chance, as with a pose that a search with the wrong focal length finds."""
    data = matches(generator)
    wrong = replace(
        data, image=3 * data.image, focal=data.focal / 3
    )  # the given focal length is 3 times too short
    start = TRUTH.retract(torch.tensor([0.0, 0.0, 2.5, 0.0, 0.0, 0.0], dtype=torch.float64))
    found = camera_fit(wrong, start, GIVEN, LIMIT)
    assert found is not None
    assert found.calibration.focal_factor == pytest.approx(3, rel=0.03)
    assert int(found.inliers.sum()) > 150


def localized(view: View, camera: Intrinsics, *, with_cameras: bool) -> Localization:
    """Localize an image without depth by landmarks alone, with intrinsics that are not its own."""
    return localized_frame(
        view, replace(view.frame, depth=None, intrinsics=camera), with_cameras=with_cameras
    )


def localized_frame(view: View, frame: Frame, *, with_cameras: bool) -> Localization:
    landmarks = textured_map().landmarks
    assert landmarks is not None
    scatter = torch.full((4,), 0.003).double()
    cameras = (CAMERA,) if with_cameras else ()
    matcher = LandmarkMatcher(replace(landmarks, calibration_scatter=scatter, cameras=cameras))
    problem = rig(textured_map(), [replace(view, frame=frame)], None)
    return localize(replace(problem, matcher=matcher), "auto", AutoConfig(fused_rays=0))


@pytest.mark.parametrize("stretch", [0.75, 1.33])
def test_auto_rejects_a_stretched_image_of_another_camera(stretch: float) -> None:
    view = unseen()
    camera = replace(view.frame.intrinsics, fx=view.frame.intrinsics.fx / stretch)
    found = localized(view, camera, with_cameras=False)
    assert found.outcome is Outcome.MISCALIBRATED
    told = re.search(r"an image (\d+)% (wider|narrower)", found.reason)
    assert told is not None
    assert int(told[1]) == pytest.approx(100 * abs(stretch - 1), abs=2)
    assert (told[2] == "wider") is (stretch > 1)


@pytest.mark.parametrize("stretch", [0.75, 1.33])
def test_auto_localizes_a_stretched_image_of_the_maps_camera(stretch: float) -> None:
    view = unseen()
    own = view.frame.intrinsics
    found = localized(view, replace(own, fx=own.fx / stretch), with_cameras=True)
    assert found.converged
    assert found.intrinsics == own
    assert "with the map's intrinsics: an image" in found.reason
    error = pose_error(found.T_world_camera, view.T_ref_camera)
    assert error.translation < 0.03
    assert error.rotation_deg < 1


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_auto_localizes_with_a_focal_length_of_which_the_maps_camera_is_a_multiple(factor: float) -> None:
    view = unseen()
    own = view.frame.intrinsics
    found = localized(view, replace(own, fx=factor * own.fx, fy=factor * own.fy), with_cameras=True)
    assert found.converged
    assert found.intrinsics == own
    assert found.focal_factor == pytest.approx(1 / factor, rel=1e-6)
    assert pose_error(found.T_world_camera, view.T_ref_camera).translation < 0.03


def found_in_part(
    cut: int,
    left: bool,
    given: float = 1.0,
    noise: float = 0.3,
    correlation: float = 1.0,
    cameras: tuple[Intrinsics, ...] = (PINHOLE,),
) -> tuple[LandmarkPose, Intrinsics, Intrinsics, SE3]:
    """Return the pose found for an image of which ``cut`` columns are missing, its true and its stated camera, and its true pose.

    ``given``: the focal length as it is stated, over the true one. It is approximate if they differ.
    """
    points = Points(noise=noise)
    scatter = torch.full((4,), 1e-3, dtype=torch.float64)
    built = build_landmarks(ring(points), points)
    landmarks = replace(built, cameras=cameras, correlation=correlation, calibration_scatter=scatter)
    width = PINHOLE.width - cut
    true = replace(PINHOLE, width=width, cx=PINHOLE.cx - (cut if left else 0))
    pose = looking_in(0.43, 0.45, 3.6)
    view = points.view(pose, true)
    stated = replace(true, fx=given * true.fx, fy=given * true.fy, cx=width / 2)
    frame = replace(view.frame, intrinsics=stated, focal_is_approximate=given != 1)
    found = propose(LandmarkMatcher(landmarks), [replace(view, frame=frame)], points)
    assert found is not None
    assert landmark_verdict(found).accepted
    return found, true, stated, pose


@pytest.mark.parametrize(("cut", "given"), [(60, 1.0), (120, 1.0), (30, 0.9), (35, 1.05), (120, 1.15)])
@pytest.mark.parametrize("left", [True, False])
def test_the_principal_point_of_a_part_of_an_image_is_estimated(cut: int, given: float, left: bool) -> None:
    """Also where few enough keypoints agree with a wrong pose that it is not certain by itself."""
    found, true, stated, pose = found_in_part(cut, left, given)
    camera = found.intrinsics_of(stated)
    assert camera is not None
    off = -cut / 2 if left else cut / 2
    assert camera.cx - stated.cx == pytest.approx(off, abs=6 if given == 1 else 8)
    assert camera.fx == pytest.approx(true.fx, rel=0.01 if given == 1 else 0.04)
    error = pose_error(found.T_world_camera, pose)
    assert error.rotation_deg < 1.5  # as stated: 6 and 11 degrees
    assert error.translation < 0.03


@pytest.mark.parametrize(("cut", "cameras"), [(35, (PINHOLE,)), (40, ())])
def test_a_probable_part_of_an_image_is_not_taken_for_a_whole_one_of_the_map(
    cut: int, cameras: tuple[Intrinsics, ...]
) -> None:
    """The keypoints are too noisy to make it certain; with the principal point in the middle, the pose is off by 2.5 degrees."""
    found, _, _, pose = found_in_part(cut, True, 0.9, noise=1.0, correlation=3.0, cameras=cameras)
    assert not found.takes_map_camera
    assert pose_error(found.T_world_camera, pose).rotation_deg < 1
    assert pose_error(found.T_world_camera, pose).translation < 0.03


def test_the_fields_of_a_pose_with_the_maps_camera_belong_together() -> None:
    view, landmarks = unseen(), textured_map().landmarks
    assert landmarks is not None
    own = view.frame.intrinsics
    stated = replace(own, fx=1.3 * own.fx, fy=1.1 * own.fy)
    matcher = LandmarkMatcher(replace(landmarks, cameras=(CAMERA,)))
    frame = replace(view.frame, depth=None, intrinsics=stated)
    found = propose(matcher, [View(frame, SE3.identity())])
    assert found is not None
    assert found.takes_map_camera
    assert found.better_camera is None
    camera = found.calibration.applied(stated)
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(own, name), abs=0.5)
    assert found.focal_factor == pytest.approx((1 / 1.3 / 1.1) ** 0.5, rel=3e-3)


def test_images_of_different_cameras_are_taken_as_they_are_given() -> None:
    views, landmarks = [unseen(), training_views()[0]], textured_map().landmarks
    assert landmarks is not None
    own = views[0].frame.intrinsics
    wrong = replace(views[0], frame=replace(views[0].frame, intrinsics=replace(own, fx=0.7 * own.fx)))
    found = propose(LandmarkMatcher(replace(landmarks, cameras=(CAMERA,))), [wrong, views[1]])
    assert found is not None
    assert found.intrinsics_of(own) is None
