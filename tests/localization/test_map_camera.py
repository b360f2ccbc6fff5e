"""The cameras of a map's images, of the same shape or of others, as an alternative to the intrinsics that a query states.

The table of ``test_answers`` has which camera an image is found to have. ``correction_between`` and ``map_cameras`` are needed here for
what no answer shows: the correction itself, and the prior odds.
"""

from __future__ import annotations

import math
from dataclasses import astuple, replace

import pytest
import torch

from bidnerf_core import Intrinsics
from bidnerf_core.camera import Orientation, stretched_cameras
from bidnerf_core.localization import LandmarkMatcher, propose

# Inside: the corrections between cameras and their prior odds, before any image is seen
from bidnerf_core.localization.landmarks.map_camera import (
    MapCamera,
    correction_between,
    map_cameras,
)
from bidnerf_core.mapping import GIVEN, Calibration, build_landmarks
from bidnerf_core.results import pose_error
from bidnerf_core.testing import training_views, unseen
from conditions import POSES, centred, ground_landmarks, part, point_view
from landmark_scene import PINHOLE, Points, ring


def with_focal(factor: float, camera: Intrinsics = PINHOLE) -> Intrinsics:
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def map_camera(given: Intrinsics, cameras: tuple[Intrinsics, ...]) -> MapCamera | None:
    """The one camera of a map whose images have one shape."""
    found = map_cameras(given, cameras)
    assert len(found) <= 1
    return found[0] if found else None


@pytest.mark.parametrize(
    "correction",
    [
        GIVEN,
        Calibration(log_focal=-0.03),
        Calibration(0.02, 0.01, -0.02, 0.0),
        Calibration(0.01, 0.0, 0.0, 0.04),
        Calibration(-0.02, 0.01, 0.0, 0.0, 0.1),
    ],
)
@pytest.mark.parametrize("given", [PINHOLE, replace(PINHOLE, distortion=(-0.02, 0.0, 0.0, 0.0))])
def test_the_correction_between_cameras_is_the_one_that_was_applied(
    given: Intrinsics, correction: Calibration
) -> None:
    found = correction_between(given, correction.applied(given))
    assert found is not None
    tolerance = 3e-3 if given.distortion else 1e-6  # two distortions make up one only approximately
    expected = torch.tensor(astuple(correction), dtype=torch.float64)
    torch.testing.assert_close(found, expected, rtol=0, atol=tolerance)


@pytest.mark.parametrize("k", [(-0.28, 0.07), (-0.35, 0.15), (0.1, 0.0)])
def test_a_strong_lens_is_corrected_where_a_correction_describes_it(k: tuple[float, float]) -> None:
    """The projections of both cameras agree to a pixel in most of the image, or there is no correction."""
    true = Intrinsics(320.0, 320.0, 320.0, 240.0, 640, 480, (*k, 0.0, 0.0))
    given = with_focal(1.02, true)
    found = correction_between(given, true)
    if found is None:
        return
    rays = true.unproject(true.pixel_centres(torch.float64)[::16, ::16])
    flat = Calibration(*found.tolist()).pixels(rays[..., :2].reshape(-1, 2), 1.0)
    seen = given.project(torch.cat([flat, torch.ones(len(flat), 1)], -1))
    off = (seen - true.project(rays.reshape(-1, 3))).norm(dim=-1)
    assert float(off.median()) < 1.0


def test_the_intrinsics_of_any_image_of_the_map_need_no_correction() -> None:
    usual, other = [with_focal(1 + 0.001 * i) for i in range(20)], with_focal(1.05)
    found = map_camera(other, (*usual, other))
    assert found is not None
    assert not bool(found.differs.any())
    assert found.intrinsics == other


def test_lenses_that_no_correction_describes_are_not_compared() -> None:
    fisheye = Intrinsics(150.0, 150.0, 200.0, 150.0, 400, 300, (-0.5, 0.0, 0.0, 0.0))
    assert map_camera(PINHOLE, (fisheye,)) is None


def test_a_resized_image_has_the_maps_camera() -> None:
    found = map_camera(PINHOLE.resized(200, 150), (PINHOLE,))
    assert found is not None
    assert not bool(found.differs.any())
    assert found.correction.abs().max() < 1e-9


def test_images_of_another_shape_are_compared_with_resized_ones() -> None:
    taller = replace(PINHOLE, height=400, cy=200.0)
    found = map_camera(taller, (PINHOLE,))
    assert found is not None
    assert found.intrinsics == PINHOLE.resized(400, 400)
    assert float(found.correction[4]) == pytest.approx(math.log(3 / 4))
    assert map_camera(PINHOLE, ()) is None


def test_a_camera_that_refocuses_differs_only_beyond_its_own_spread() -> None:
    cameras = tuple(with_focal(1 + 0.01 * math.sin(i)) for i in range(40))
    inside, outside = (map_camera(with_focal(factor), cameras) for factor in (1.01, 1.05))
    assert inside is not None
    assert outside is not None
    assert not bool(inside.differs.any())
    assert outside.differs.tolist() == [True, False, False, False, False]
    assert float(outside.deviations[0]) == pytest.approx(0.0075, rel=0.2)


def test_the_farther_the_cameras_are_apart_the_less_likely_they_are_one() -> None:
    found = [map_camera(with_focal(factor), (PINHOLE,)) for factor in (1.01, 1.03, 1.06, 1.2, 2.0)]
    odds = [camera.log_odds for camera in found if camera is not None]
    assert odds == sorted(odds, reverse=True)
    assert odds[-1] == -math.inf


@pytest.mark.parametrize(
    ("correction", "words"),
    [
        (Calibration(log_focal=0.05), "a focal length 5.1% longer than given"),
        (Calibration(log_focal=-0.05), "a focal length 4.9% shorter than given"),
        (Calibration(radial=-0.03), "a radial distortion 0.030 lower than given"),
        (
            Calibration(log_focal=0.05, shift_u=-0.1, shift_v=0.02),
            "a focal length 5.1% longer and a principal point 10.0% of the focal length further left and 2.0% of the focal"
            " length further down than given",
        ),
        (Calibration(log_focal=0.001, radial=0.001), "nearly the same as given"),
    ],
)
def test_a_correction_reads_as_words(correction: Calibration, words: str) -> None:
    assert correction.compared("given") == words
    assert correction.compared("assumed") == words.replace("given", "assumed")


@pytest.mark.parametrize(("cut", "cameras"), [(35, (PINHOLE,)), (40, ())])
def test_a_probable_part_of_an_image_is_not_taken_for_a_whole_one_of_the_map(
    cut: int, cameras: tuple[Intrinsics, ...]
) -> None:
    """The keypoints are too noisy to make it certain; with the principal point in the middle, the pose is off by 2.5 degrees."""
    points, true = Points(noise=1.0), part(cut, 0, 1)
    built = build_landmarks(ring(points), points)
    scatter = torch.full((4,), 1e-3, dtype=torch.float64)
    landmarks = replace(built, cameras=cameras, correlation=3.0, calibration_scatter=scatter)
    view = point_view(points, POSES[0], true=true, stated=centred(true, 0.9), approximate=True)
    found = propose(LandmarkMatcher(landmarks), [view], points)
    assert found is not None
    assert not found.takes_map_camera
    assert pose_error(found.T_world_camera, POSES[0]).rotation_deg < 1
    assert pose_error(found.T_world_camera, POSES[0]).translation < 0.03


def test_images_of_different_cameras_are_taken_as_they_are_given() -> None:
    views = [unseen(), training_views()[0]]
    own = views[0].frame.intrinsics
    wrong = replace(views[0], frame=replace(views[0].frame, intrinsics=replace(own, fx=0.7 * own.fx)))
    found = propose(LandmarkMatcher(ground_landmarks()), [wrong, views[1]])
    assert found is not None
    assert found.intrinsics_of(own) is None


LANDSCAPE = Intrinsics(520.0, 521.0, 310.0, 245.0, 640, 480, (0.05, -0.01, 0.001, 0.002))
TILTED = replace(LANDSCAPE, distortion=(0.0,) * 12 + (0.1, 0.0))
POINTS = torch.tensor([[0.1, -0.2, 1.0], [-0.4, 0.3, 2.0], [0.5, 0.1, 1.5]], dtype=torch.float64)


def test_quarter_turns_go_to_both_sides() -> None:
    one, other = LANDSCAPE.quarter_turns()
    assert (one.width, one.height) == (other.width, other.height) == (480, 640)
    assert one != other
    assert {camera for turned in (one, other) for camera in turned.quarter_turns()} >= {LANDSCAPE}
    assert TILTED.quarter_turns() == ()


@pytest.mark.parametrize("number", [0, 1])
def test_a_turned_camera_sees_what_a_turned_image_shows(number: int) -> None:
    turned, orientation = LANDSCAPE.quarter_turns()[number], Orientation.from_exif((6, 8)[number])
    angle = math.pi / 2 * (1 if orientation.mirrors_rows else -1)
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]],
        dtype=torch.float64,
    )
    u, v = LANDSCAPE.project(POINTS).unbind(-1)
    upright = torch.stack([480 - v, u] if orientation.mirrors_rows else [v, 640 - u], dim=-1)
    assert torch.allclose(turned.project(POINTS @ turn.mT), upright)


@pytest.mark.parametrize(("width", "height", "scale"), [(480, 480, 1.0), (320, 180, 0.5), (640, 480, 1.0)])
def test_a_centre_crop_touches_two_edges(width: int, height: int, scale: float) -> None:
    part = LANDSCAPE.centre_crop(width, height)
    shift = torch.tensor([(640 * scale - width) / 2, (480 * scale - height) / 2], dtype=torch.float64)
    assert torch.allclose(part.project(POINTS) + shift, scale * LANDSCAPE.project(POINTS))
    assert float(shift.min()) == 0


def test_the_map_camera_of_a_portrait_image_is_turned_to_either_side() -> None:
    given = Intrinsics.from_focal(540, 480, 640)
    one, other = LANDSCAPE.quarter_turns()
    found = map_cameras(given, (LANDSCAPE, LANDSCAPE))
    assert [camera.intrinsics for camera in found] == [one, other]
    assert float(found[0].correction[0].exp()) == pytest.approx(520.5 / 540, rel=0.005)
    assert stretched_cameras((LANDSCAPE,), 480, 640) == ((one,), (other,))


def test_of_landscape_and_portrait_images_those_of_the_shape_of_the_query_are_taken() -> None:
    one, _ = LANDSCAPE.quarter_turns()
    portrait = replace(one, fx=500.0, fy=500.0)
    for cameras in ((LANDSCAPE, portrait), (portrait, LANDSCAPE)):
        (found,) = map_cameras(Intrinsics.from_focal(510, 480, 640), cameras)
        assert found.intrinsics == portrait
    assert map_cameras(portrait, (TILTED,)) == []
    assert map_cameras(portrait, ()) == []


def test_crops_are_compared_only_on_demand() -> None:
    square = Intrinsics.from_focal(400, 480, 480)
    assert LANDSCAPE.centre_crop(480, 480) not in [c.intrinsics for c in map_cameras(square, (LANDSCAPE,))]
    found = map_cameras(square, (LANDSCAPE,), crops=True)
    assert LANDSCAPE.centre_crop(480, 480) in [camera.intrinsics for camera in found]
    (whole,) = map_cameras(
        Intrinsics.from_focal(400, 640, 480), (LANDSCAPE, LANDSCAPE.centre_crop(480, 480)), crops=True
    )
    assert whole.intrinsics == LANDSCAPE
