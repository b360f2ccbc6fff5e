"""Which scenes are contracted, and the bounds that landmarks give where images have colour only."""

import math
import statistics
from dataclasses import replace

import pytest
import torch

import tiny
from bidnerf import SE3, Frame, Intrinsics, View
from bidnerf_core.carving import estimate_bounds
from bidnerf_core.errors import InputError
from bidnerf_core.mapping import LandmarkConfig, track_views
from landmark_scene import Points, ring
from test_carving import in_other_units

CAMERA = Intrinsics(60.0, 60.0, 32.0, 24.0, 64, 48)


def wall(measured_rows: int) -> View:
    """A wall three metres away, whose depth was measured in the upper rows of 48."""
    depth = torch.zeros(48, 64)
    depth[:measured_rows] = 3.0
    return View(Frame("wall", torch.zeros(48, 64, 3), CAMERA, depth), SE3.identity())


def captured() -> list[View]:
    """Views of the landmark scene with the landmarks that they see."""
    points = Points()
    views = ring(points)
    seen = track_views(views, points).landmarks_by_image(LandmarkConfig())
    return [replace(view, landmarks=part) for view, part in zip(views, seen, strict=True)]


@pytest.mark.parametrize(
    ("rows", "contracted"),
    [([48], False), ([30], False), ([1], True), ([48, 0], False), ([48, 0, 0], True)],
)
def test_a_scene_is_contracted_unless_a_sensor_measured_its_depth(rows: list[int], contracted: bool) -> None:
    """Half of the views may lack it."""
    assert estimate_bounds([wall(count) for count in rows]).contracted == contracted


def test_silhouettes_leave_nothing_beyond_the_box() -> None:
    bare = [replace(view, frame=replace(view.frame, depth=None)) for view in tiny.views(3)]
    assert not estimate_bounds(bare).contracted
    opaque = [replace(view, frame=replace(view.frame, alpha=None)) for view in bare]
    assert estimate_bounds(opaque).contracted


def test_matter_beyond_the_box_is_within_reach() -> None:
    closed, opened = estimate_bounds([wall(48)]), estimate_bounds([wall(1)])
    assert opened.far > 1.5 * closed.far


def test_landmarks_give_a_box_around_most_of_them() -> None:
    """The points of the scene lie in the cube [-1, 1]: 90 % of each axis is 1.8 long."""
    views = captured()
    bounds = estimate_bounds(views)
    assert bounds.contracted
    assert all(1.6 < size < 2.0 for size in bounds.size)
    assert max(abs(middle) for middle in bounds.centre) < 0.1
    distances = torch.cat([view.landmarks.distance for view in views if view.landmarks is not None])
    assert 0.4 * float(distances.min()) < bounds.near < float(distances.min())
    assert bounds.far > 1.5 * float(distances.max())


def test_bounds_by_landmarks_have_no_unit() -> None:
    views = captured()
    here = estimate_bounds(views)
    there = estimate_bounds([in_other_units(view, 50.0, torch.zeros(3)) for view in views])
    for part in ("near", "far", "lower", "upper", "footprint"):
        expected = 50 * torch.tensor(getattr(here, part))
        torch.testing.assert_close(torch.tensor(getattr(there, part)), expected, rtol=1e-4, atol=1e-4)


def test_a_few_landmarks_give_no_box() -> None:
    few = [
        replace(view, landmarks=replace(view.landmarks, **{k: v[:3] for k, v in vars(view.landmarks).items()}))
        for view in captured()
        if view.landmarks is not None
    ]
    bare = [replace(view, landmarks=None) for view in few]
    assert estimate_bounds(few) == estimate_bounds(bare)


@pytest.mark.parametrize("rows", [48, 1])
def test_measured_depth_determines_what_a_pixel_shows(rows: int) -> None:
    """The mean focal length is 60 px, and the middle one of three walls is two metres away.

    Each has a nearer object in a quarter of it.
    """
    camera, views = replace(CAMERA, fx=50.0, fy=70.0), list[View]()
    for distance in (1.0, 2.0, 9.0):
        depth = torch.full((48, 64), distance)
        depth[:, :16] = distance / 2
        depth[rows:] = 0
        views.append(View(Frame(f"{distance}", torch.zeros(48, 64, 3), camera, depth), SE3.identity()))
    assert estimate_bounds(views).footprint == pytest.approx(2 / 60)


def test_landmarks_tell_what_a_pixel_shows() -> None:
    views = captured()
    medians = [float(v.landmarks.distance.median()) for v in views if v.landmarks is not None]
    expected = statistics.median(medians) / views[0].frame.intrinsics.fx
    assert estimate_bounds(views).footprint == pytest.approx(expected)


def test_without_distances_a_pixel_is_taken_to_show_the_middle_of_the_scene() -> None:
    bare = [replace(view, frame=replace(view.frame, depth=None)) for view in tiny.views(3)]
    bounds = estimate_bounds(bare)
    away = [math.dist(view.T_ref_camera.translation.tolist(), bounds.centre) for view in bare]
    assert bounds.footprint == pytest.approx(statistics.median(away) / tiny.CAMERA.fx, rel=1e-4)


def test_a_camera_amid_the_scene_is_taken_to_show_what_is_half_its_side_away() -> None:
    bounds = estimate_bounds([wall(0)])
    assert bounds.footprint >= bounds.side / 2 / CAMERA.fx


def test_a_single_wrong_distance_does_not_tell_what_pixels_show() -> None:
    """Silhouettes give the box, so they also tell the distance; and so do the cameras where there are too few landmarks."""
    bare = [replace(view, frame=replace(view.frame, depth=None)) for view in tiny.views(3)]
    far = torch.zeros(tiny.SIZE, tiny.SIZE)
    far[0, 0] = 500.0
    astray = replace(bare[0], frame=replace(bare[0].frame, depth=far))
    assert estimate_bounds([astray, *bare[1:]]) == estimate_bounds(bare)


@pytest.mark.parametrize("footprint", [-1.0, math.nan, math.inf])
def test_a_footprint_that_is_no_length_is_refused(footprint: float) -> None:
    with pytest.raises(InputError):
        replace(estimate_bounds([wall(48)]), footprint=footprint)
