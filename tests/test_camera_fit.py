"""Cropped and stretched images: told from the matches that a pose leaves out, localized where they are the map camera's or cropped."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import torch
from torch import Generator

from bidnerf_core import Localization, Outcome, View
from bidnerf_core.camera import Intrinsics
from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.localization import AutoConfig
from bidnerf_core.localization.problem import rig
from bidnerf_core.localization.search.camera_fit import LEAST_STRETCH, UNSUSPECTED, CameraFit, better_camera
from bidnerf_core.localization.search.map_camera import camera_like
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.mapping.calibration import GIVEN, UNSTRETCHED, Calibration, Stretch
from bidnerf_core.mapping.observed_points import ObservedPoints
from bidnerf_core.se3 import SE3
from problems import localize
from textured_field import CAMERA, textured_map, unseen

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
        0 * each, eye, torch.zeros((count, 3), dtype=torch.float64),
    )  # fmt: skip


def agreeing(data: ObservedPoints, T: SE3) -> int:
    return int((torch.linalg.vector_norm(data.residuals(T), dim=-1) <= LIMIT).sum())


def fitted(data: ObservedPoints, start: SE3 = TRUTH) -> CameraFit:
    found = better_camera(data, start, GIVEN, LIMIT, agreeing(data, start))
    assert found is not None
    return found


@pytest.mark.parametrize("across", [0.6, 0.9, 1.1, 1.5])
def test_a_stretch_is_estimated_from_a_pose_that_few_matches_agree_with(
    across: float, generator: Generator
) -> None:
    """The focal length down is as given, so that all of the change is across."""
    found = fitted(matches(generator, across))
    assert found.stretch.across / found.stretch.down == pytest.approx(across, rel=0.01)
    assert found.stretch.down == 1
    assert found.calibration.log_focal == pytest.approx(0, abs=0.03)
    assert pose_error(found.T_world_rig, TRUTH).translation < 0.1


@pytest.mark.parametrize("shift", [(-0.15, 0.0), (0.1, 0.08), (0.0, -0.2)])
def test_a_part_of_an_image_is_told_from_its_principal_point(
    shift: tuple[float, float], generator: Generator
) -> None:
    """From a pose that is turned by as much as the principal point is off, as one that takes the middle of the part for it."""
    turn = torch.tensor([0.0, 0.0, 0.0, shift[1], -shift[0], 0.0], dtype=torch.float64)
    data, start = matches(generator, shift=shift), TRUTH.retract(turn)
    assert pose_error(start, TRUTH).rotation_deg > 5
    found = fitted(data, start)
    assert found.stretch == UNSTRETCHED
    assert (found.calibration.shift_u, found.calibration.shift_v) == pytest.approx(shift, abs=0.03)
    assert pose_error(found.T_world_rig, TRUTH).rotation_deg < 2
    camera = found.camera(Intrinsics(FOCAL, FOCAL, 320.0, 240.0, 640, 480))
    assert (camera.cx - 320, camera.cy - 240) == pytest.approx((FOCAL * shift[0], FOCAL * shift[1]), abs=15)


def test_the_right_camera_is_not_suspected(generator: Generator) -> None:
    for wrong in (0, 40, 120):
        data = matches(generator, wrong=wrong)
        assert better_camera(data, TRUTH, GIVEN, LIMIT, agreeing(data, TRUTH)) is None


def test_garbage_has_no_camera_and_does_no_harm(generator: Generator) -> None:
    """Points at, behind and far beyond the camera, matched at random."""
    data = matches(generator, wrong=200)
    odd = data.points.clone()
    odd[::4], odd[1::4] = TRUTH.translation, 1e12 * odd[1::4]
    odd[2::4] = TRUTH.apply(torch.tensor([0.3, 0.1, 1e-300], dtype=torch.float64))
    assert better_camera(replace(data, points=odd), TRUTH, GIVEN, LIMIT, 10) is None


def test_a_stretch_within_the_errors_of_lenses_is_not_told(generator: Generator) -> None:
    data = matches(generator, 1 + 0.5 * LEAST_STRETCH, wrong=100)
    found = better_camera(data, TRUTH, GIVEN, LIMIT, 20)
    assert found is not None
    assert found.stretch == UNSTRETCHED


def test_a_pose_that_most_matches_agree_with_is_not_questioned(generator: Generator) -> None:
    data = matches(generator, 1.2)
    most = int(UNSUSPECTED * len(data)) + 1
    assert better_camera(data, TRUTH, GIVEN, LIMIT, most) is None
    assert better_camera(data, TRUTH, GIVEN, LIMIT, 0) is None


def test_intrinsics_of_a_stretch_and_a_correction_project_as_their_fit_says() -> None:
    """x = (factor X/Z) stretched across plus the shift, in units of the given focal length."""
    given = Intrinsics(400.0, 400.0, 320.0, 240.0, 640, 480)
    stretch, calibration = Stretch(1.2, 0.9), Calibration(0.05, 0.1 / 1.2, -0.06 / 0.9)
    camera = calibration.applied(stretch.applied(given))
    point = torch.tensor([[0.3, -0.2, 1.5]], dtype=torch.float64)
    u, v = camera.project(point)[0].tolist()
    factor = calibration.focal_factor
    assert u == pytest.approx(320 + 400 * (0.2 * 1.2 * factor + 0.1))
    assert v == pytest.approx(240 + 400 * (-0.2 / 1.5 * 0.9 * factor - 0.06))


def test_the_maps_camera_is_recognised_in_another_shape_only_if_it_is_alike() -> None:
    cameras = (Intrinsics(300.0, 300.0, 200.0, 150.0, 400, 300),)
    square = cameras[0].resized(256, 256)
    near = replace(square, fx=1.02 * square.fx, fy=1.02 * square.fy, cx=square.cx + 3)
    assert camera_like(near, cameras) == square
    assert camera_like(replace(square, fx=1.1 * square.fx, fy=1.1 * square.fy), cameras) is None
    assert camera_like(replace(square, fx=1.04 * square.fx), cameras) is None
    assert camera_like(replace(square, cx=square.cx + 20), cameras) is None
    assert camera_like(square, ()) is None


def localized(view: View, camera: Intrinsics, *, with_cameras: bool) -> Localization:
    """Localize an image without depth by landmarks alone, with intrinsics that are not its own."""
    frame = replace(view.frame, depth=None, intrinsics=camera)
    landmarks = textured_map().landmarks
    assert landmarks is not None
    scatter = torch.full((4,), 0.01).double()
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
    told = re.search(r"an image (\d+)% (wider|narrower) than stated", found.reason)
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
