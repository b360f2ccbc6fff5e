"""The record of a capture: damaged photos are named, sound ones are not, and the words say so."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from bidnerf import SE3, Frame, Intrinsics, View
from bidnerf.results import draw_capture
from bidnerf.scenes import demo_object, orbit, views
from bidnerf.testing import BOUNDS, TexturedGround, textured_map
from bidnerf_core.captures import (
    CaptureReport,
    CoverageRecord,
    UpDirection,
    sentences,
    summary,
    survey_capture,
    up_from_gravity,
)

# Inside: the measures of single photos and pairs, of which a report gives only the remarks
from bidnerf_core.captures.report import SUMMARY_LINES
from bidnerf_core.captures.survey import groups
from bidnerf_core.fields import Stratified, render_image
from bidnerf_core.geometry import look_at
from bidnerf_core.mapping import HeldOutTrial, track_views
from bidnerf_core.training import photo_measures
from landmark_scene import Points, looking_in, ring
from optional import require
from refusals import refused

CAMERA = Intrinsics(162.0, 162.0, 80.0, 60.0, 160, 120)


@functools.cache
def photos() -> tuple[View, ...]:
    """Photos of the textured ground from all sides."""
    poses, field = orbit(1.8, 16, elevation=(45.0, 75.0), seed=0), TexturedGround()
    fine = torch.tensor([1.0, 3.0]).repeat(12)  # half of the waves are short, so that there is detail to lose
    field.waves, field.sampler = field.waves * fine, Stratified(40)
    images = [render_image(field, CAMERA, T, BOUNDS).rgb for T in poses]
    return tuple(View(Frame(f"{i:02d}", rgb, CAMERA), T) for i, (rgb, T) in enumerate(zip(images, poses, strict=True)))


def survey(views: list[View]) -> CaptureReport:
    return survey_capture(track_views(views), views)


def changed(views: list[View], number: int, rgb: torch.Tensor) -> None:
    views[number] = replace(views[number], frame=replace(views[number].frame, rgb=rgb))


@functools.cache
def damaged() -> CaptureReport:
    """The record of the photos with one damage of each kind."""
    views = list(photos())
    T = views[2].T_ref_camera
    views[2] = replace(views[2], T_ref_camera=T @ SE3.exp(torch.tensor([0.1, 0, 0, 0, 0.15, 0], dtype=torch.float64)))
    changed(views, 5, views[5].frame.rgb.flip(0, 1))
    changed(views, 8, views[8].frame.rgb.flip(1))
    changed(views, 11, torch.from_numpy(cv2.blur(views[11].frame.rgb.numpy(), (7, 1))))
    changed(views, 14, views[14].frame.rgb * 2 ** (-3 / 2.2))
    return survey(views)


def names(report: CaptureReport, problem: str) -> list[str]:
    return [photo.name for photo in report.photos if problem in photo.problems]


@pytest.mark.slow
def test_nothing_is_named_of_sound_photos() -> None:
    report = survey(list(photos()))
    assert [photo.problems for photo in report.photos] == [()] * 16
    assert report.coverage.arrangement == "around"
    assert report.coverage.gaps == ()
    assert {photo.group for photo in report.photos} == {0}
    assert torch.tensor(report.coverage.centre).norm() < 0.2


@pytest.mark.parametrize(
    ("problem", "number"),
    [("badly posed", 2), ("turned", 5), ("mirrored", 8), ("blurred", 11), ("badly exposed", 14)],
)
def test_each_damage_is_named_and_nothing_else(problem: str, number: int) -> None:
    assert names(damaged(), problem) == [f"{number:02d}"]


def test_how_far_a_pose_is_off_is_measured() -> None:
    photo = damaged().photos[2]
    assert photo.pose_translation == pytest.approx(0.1, abs=0.02)
    assert photo.pose_rotation_deg == pytest.approx(math.degrees(0.15), abs=0.5)
    turned = damaged().photos[5]
    assert turned.pose_rotation_deg == pytest.approx(180, abs=1)


def test_exposure_is_measured_in_stops() -> None:
    assert damaged().photos[14].exposure == pytest.approx(-3, abs=0.3)
    # The badly posed photo shows too few landmarks.
    stops = [photo.exposure for photo in damaged().photos[:5] if photo.exposure is not None]
    assert len(stops) == 4
    assert max(map(abs, stops)) < 0.2


def test_a_missing_side_is_named_by_the_photos_beside_it() -> None:
    views = ring(points := Points(noise=0.3), 60)[::2]
    left = [view for i, view in enumerate(views) if not 10 <= i < 15]
    named = [replace(view, frame=replace(view.frame, name=f"{i}")) for i, view in enumerate(left)]
    report = survey_capture(track_views(named, points), named)
    assert report.coverage.arrangement == "around"
    (gap,) = report.coverage.gaps
    assert {gap.after, gap.before} == {"9", "10"}  # of those that are left
    assert gap.degrees == pytest.approx(math.degrees(12 * 0.105), abs=3)


def test_one_side_is_no_gap() -> None:
    views = ring(points := Points(), 12)
    report = survey_capture(track_views(views, points), views)
    assert report.coverage.arrangement == "one side"
    assert report.coverage.gaps == ()
    assert require(report.coverage.open_side).degrees == pytest.approx(360 - 11 * math.degrees(0.105), abs=3)


def test_a_few_photos_that_overlap_are_not_isolated() -> None:
    views = ring(points := Points(), 4)
    report = survey_capture(track_views(views, points), views)
    assert [(photo.group, photo.problems) for photo in report.photos] == [(0, ())] * 4


def towards(eye: tuple[float, float, float], forward: tuple[float, float, float]) -> SE3:
    return look_at(eye, [e + f for e, f in zip(eye, forward, strict=True)])


def surroundings(poses: list[SE3], stretch: float, up: UpDirection | None = None, count: int = 300) -> CaptureReport:
    """Survey photos of points in a box, which is long along x."""
    points = Points(count)
    points.positions = points.positions * points.positions.new_tensor([stretch, 1, 1])
    views = [replace(view := points.view(T), frame=replace(view.frame, name=f"{i}")) for i, T in enumerate(poses)]
    return survey_capture(track_views(views, points), views, up=up)


def test_photos_from_inside_a_room_have_no_open_side() -> None:
    """All look to one half of the room, from its middle, and down."""
    angles = [math.pi * (i / 23 - 0.5) for i in range(24)]
    poses = [
        towards((0.4 * math.cos(3 * a), 0.4 * math.sin(3 * a), 0.2), (math.cos(a), math.sin(a), -0.4)) for a in angles
    ]
    report = surroundings(poses, 1, count=600)
    assert report.coverage.arrangement == "inside"
    assert (report.coverage.open_side, report.coverage.gaps) == (None, ())
    words = sentences(report)
    assert any("taken from inside the scene, looking -22° to -22° up" in sentence for sentence in words)
    assert not any("no photos" in sentence for sentence in words)


def test_photos_along_a_corridor_are_inside_although_their_axes_meet_far_ahead() -> None:
    poses = [towards((-7.5 + 0.5 * i, 0.1 * (-1) ** i, 0.0), (1.0, -0.01 * (-1) ** i, 0.05)) for i in range(24)]
    report = surroundings(poses, 8)
    assert report.coverage.arrangement == "inside"
    assert report.coverage.open_side is None


def test_photos_past_a_facade_are_from_one_side_and_above() -> None:
    """Parallel axes meet nowhere, but the scene is in front of all cameras."""
    poses = [towards((0.3 * i - 1.5, -5.0, 3.0), (0.0, 1.0, -0.6)) for i in range(11)]
    report = surroundings(poses, 1, up_from_gravity((0, 0, 1)))
    assert report.coverage.arrangement == "one side"
    assert report.coverage.heights_deg == pytest.approx((31, 31), abs=3)


def test_photos_of_two_places_are_two_groups() -> None:
    one = Points(noise=0.3)
    two = Points(noise=0.3)
    generator = torch.Generator().manual_seed(9)
    two.descriptors = one.descriptors[:, torch.randperm(64, generator=generator)]
    two.positions = two.positions[torch.randperm(two.count, generator=generator)]
    views = ring(one, 10)
    two.seen = one.seen  # both number their images in one list
    views += [two.view(looking_in(0.105 * i + 0.05), seed=i) for i in range(5)]
    views = [replace(view, frame=replace(view.frame, name=f"{i}")) for i, view in enumerate(views)]
    report = survey_capture(track_views(views, one), views)
    assert names(report, "apart") == ["10", "11", "12", "13", "14"]
    assert [photo.group for photo in report.photos] == [0] * 10 + [1] * 5
    assert any("another place" in sentence for sentence in sentences(report))


def test_photos_from_one_place_have_no_parallax() -> None:
    points = Points()
    T = looking_in(0.0)
    turns = [SE3.exp(torch.tensor([0, 0, 0, 0, 0.02 * i, 0.01 * i], dtype=torch.float64)) for i in range(9)]
    views = [points.view(T @ turn) for turn in turns]
    report = survey_capture(track_views(views, points), views)
    assert report.coverage.arrangement == "one place"
    assert report.coverage.parallax_deg < 0.1
    assert not {"isolated", "apart", "badly posed"} & {each for photo in report.photos for each in photo.problems}
    assert any("from one place do not determine distances" in sentence for sentence in sentences(report))


@pytest.mark.parametrize("count", [1, 2])
def test_few_photos_are_recorded_and_more_are_recommended(count: int) -> None:
    report = survey(list(photos()[:count]))
    assert len(report.photos) == count
    assert not any(photo.problems for photo in report.photos)
    assert any("hardly enough" in sentence for sentence in sentences(report))


def test_photos_without_texture_are_recorded() -> None:
    plain = [replace(view, frame=replace(view.frame, rgb=torch.full((120, 160, 3), 0.5))) for view in photos()[:9]]
    report = survey(plain)
    assert report.coverage.landmarks == 0
    assert "no landmark" in sentences(report)[0]


def test_a_dark_scene_and_a_light_one_have_the_same_sharpness() -> None:
    halves = [view.frame.rgb_bytes // 2 for view in photos()[:4]]
    views, dark = (
        [replace(v, frame=v.frame.replace(rgb=n * h)) for v, h in zip(photos(), halves, strict=False)] for n in (2, 1)
    )
    assert torch.allclose(photo_measures(views)[0], photo_measures(dark)[0], atol=1e-3)


@pytest.mark.parametrize("size", [(5, 1), (1, 5), (5, 5)])
@pytest.mark.parametrize("hidden", [False, True])
def test_blur_in_any_direction_costs_sharpness(size: tuple[int, int], hidden: bool, generator: torch.Generator) -> None:
    """Also if all but the middle is hidden, is not blurred, and has twice the contrast."""
    noise = torch.rand((120, 160, 3), generator=generator).numpy() / 2
    images, around = [noise, cv2.blur(noise, size)], torch.zeros((120, 160), dtype=torch.bool)
    if hidden:
        around[:30] = around[90:] = around[:, :30] = around[:, 130:] = True
        images = [np.where(around[..., None].numpy(), 2 * noise, image) for image in images]
    frames = [Frame("a", torch.from_numpy(image), CAMERA).with_hidden(around) for image in images]
    before, after = photo_measures([View(frame, SE3.identity()) for frame in frames])[0].tolist()
    assert after < before - 0.3


def test_the_exposure_of_a_photo_without_landmarks_is_unknown() -> None:
    views = list(photos())
    changed(views, 3, torch.full((120, 160, 3), 0.5))
    report = survey(views)
    assert [photo.name for photo in report.photos if photo.exposure is None] == ["03"]
    assert any("compare the exposure of 03" in line for line in sentences(report))


@pytest.mark.parametrize(("stops", "remarked"), [(1.0, False), (1.01, True)])
def test_exposure_that_varies_by_more_than_a_stop_is_remarked(stops: float, remarked: bool) -> None:
    lines = sentences(CaptureReport((), CoverageRecord(), exposure_range=stops))
    assert any("exposure varies" in line for line in lines) is remarked


def test_the_errors_of_a_map_are_in_its_unit() -> None:
    report = CaptureReport((), CoverageRecord(), trial=HeldOutTrial(9, 8, 0.00275, 0.034))
    for unit, shown in (("metres", "median error 0.00275 m and 0.034°"), ("units", "0.00275 units and")):
        assert any(shown in line for line in sentences(report, unit))


@pytest.mark.parametrize("found", [1, 8])
def test_the_forecast_is_of_landmarks_alone_and_a_lower_bound(found: int) -> None:
    trial = HeldOutTrial(9, found, 0.00275, 0.034)
    (forecast,) = [line for line in sentences(CaptureReport((), CoverageRecord(), trial=trial)) if "expect" in line]
    was = "was" if found == 1 else "were"
    assert f"without field or depth, {found} of 9 photos of the map {was} localized" in forecast
    assert "expect this or better for new photos taken the same way" in forecast
    nothing = CaptureReport((), CoverageRecord(), trial=HeldOutTrial(0, 0))
    assert not [line for line in sentences(nothing) if "localized" in line]


def test_groups_are_numbered_by_size() -> None:
    links = torch.zeros((9, 9), dtype=torch.bool)
    for i, j in [(0, 1), (1, 2), (3, 4), (4, 5), (5, 6), (7, 8)]:
        links[i, j] = links[j, i] = True
    assert groups(links).tolist() == [1, 1, 1, 0, 0, 0, 0, -1, -1]


def test_a_summary_has_five_lines_and_the_gravest_first() -> None:
    lines = summary(damaged())
    assert len(lines) == SUMMARY_LINES
    assert "08 is mirrored" in lines[1]
    assert "more remarks" in lines[-1]


@pytest.mark.slow
def test_a_picture_is_drawn_of_cameras_gaps_and_landmarks(tmp_path: Path) -> None:
    report = damaged()
    draw_capture(report, textured_map().landmarks, tmp_path / "a" / "capture.png")
    image = cv2.imread(str(tmp_path / "a" / "capture.png"))
    assert image.shape[0] > 500
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50
    with refused(where=tmp_path, found="cannot be written (Is a directory)"):
        draw_capture(report, None, tmp_path)


@pytest.mark.slow
def test_exact_poses_of_small_images_are_not_called_wrong() -> None:
    """A pose by twenty landmarks scatters more than the usual one by forty."""
    images = views(demo_object(), Intrinsics(175.0, 175.0, 64.0, 64.0, 128, 128), orbit(3.5, 30, seed=0))
    found = survey_capture(track_views(images), images)
    assert [photo.name for photo in found.photos if "badly posed" in photo.problems] == []
