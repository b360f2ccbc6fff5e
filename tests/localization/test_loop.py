"""The answers of the loop to images under every condition of the camera, the image and the scene: a table for each of two scenes.

Nothing may be accepted that is wrong. Beyond that, a row states whose camera the answer has to have, whether it has to find that
the camera moved while the rows were exposed, and the largest error of the pose, whose covariance has to cover the true one; or the
outcome of an image without a right answer. The confidence, which was fitted to real captures, plays no part.
"""

from __future__ import annotations

import functools
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, NamedTuple

import pytest
import torch

from bidnerf import SE3, Intrinsics, Localization, Localizer, Outcome, View
from bidnerf.evaluation import faulty
from bidnerf.results import pose_error
from bidnerf.testing import GROUND_CAMERA, TexturedGround, textured_map, textured_view, training_views, unseen
from bidnerf.testing import POSES as GROUND_POSES
from bidnerf_core.fields import FieldValues
from bidnerf_core.localization import AutoConfig, LandmarkAnswer, LandmarkMatcher, LogisticModel, Loop, rig

# Inside: the answer at a proposal that is given, with the matches it is compared with
from bidnerf_core.localization.matching import STRONGEST
from bidnerf_core.localization.propose import proposal_at
from bidnerf_core.mapping import concatenate
from bidnerf_core.registry import registered
from conditions import (
    COPY,
    NOT_RENDERED,
    POSES,
    QUICK,
    CountedDetector,
    centred,
    collage,
    ground_landmarks,
    ground_view,
    ground_views,
    part,
    point_landmarks,
    point_view,
    points,
    resized,
    restated,
    scaled,
    shifted,
    twice,
    with_landmarks,
)
from landmark_scene import PINHOLE, looking_in
from localizations import CHI2_999, assert_covered, assert_near, colour_only
from optional import require

LARGEST = 0.05, 2.0
"""Largest error of any accepted pose: metres and degrees, at distances of 1.7 to 4.4 m."""


class Right(NamedTuple):
    """A right answer."""

    camera: str | None = (
        "given"  # whose intrinsics it has: the "given" ones, the "map"'s, or "estimated" ones; None: any
    )
    moved: bool | None = False  # whether it says that the camera moved; None: either
    metres: float = 0.0075
    degrees: float = 0.15


MAP, MOVED = Right("map"), Right(moved=True, metres=0.0082)
ESTIMATED = Right("estimated", metres=0.016, degrees=0.49)
REJECTED = None  # for any reason
MAY_BE_REJECTED = "either"
Expected = Right | Outcome | str | None

MOTION = torch.tensor([0.0, 0.01, 0.0, 0.0, 0.02, 0.015], dtype=torch.float64)  # first row to last
SLIGHT = torch.tensor([0.0, 0.01, 0.0, 0.0, 0.0, 0.012], dtype=torch.float64)


@pytest.fixture(autouse=True)
def certain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bounds alone decide."""
    accept = import_module("bidnerf_core.localization.accept")
    monkeypatch.setattr(accept, "model", lambda: LogisticModel({}, 10.0))


def near(T: SE3) -> SE3:
    return T.retract(torch.tensor([1.0, 0.5, 0.0, 0.1, 0.0, 0.0], dtype=torch.float64))


def assert_as_expected(found: Localization, truth: SE3, expected: Expected, true: Intrinsics) -> None:
    """Compare an answer with the true pose and the ``true`` camera."""
    error = pose_error(found.T_world_camera, truth)
    away, turned = float(error.translation), float(error.rotation_deg)
    largest = (expected.metres, expected.degrees) if isinstance(expected, Right) else LARGEST
    is_near = away <= largest[0] and turned <= largest[1]
    assert is_near or not found.converged, f"accepted, and off by {away} m and {turned} degrees"
    if isinstance(expected, Right):
        camera = "map" if "the map's camera" in found.reason else "estimated"
        camera = "given" if found.intrinsics is None else camera
        moved = "rolling shutter" in found.reason
        assert (found.outcome, camera) == (Outcome.CONVERGED, expected.camera or camera), found.reason
        assert expected.moved in (None, moved), found.reason
        assert_covered(found.T_world_camera, truth, found.covariance, CHI2_999)
        if found.intrinsics is not None:
            assert found.intrinsics.fx == pytest.approx(true.fx, rel=0.04)
            assert (found.intrinsics.cx, found.intrinsics.cy) == pytest.approx((true.cx, true.cy), abs=8)
    elif isinstance(expected, Outcome):
        assert found.outcome is expected, found.reason
    elif expected is REJECTED:
        assert not found.converged, found.reason


POINTS: dict[str, tuple[dict[str, Any], Expected]] = {
    "as stated, 0": ({}, Right()),
    "as stated, 2": ({"pose": 2}, Right(metres=0.011, degrees=0.19)),
    "focal 0.95": ({"pose": 1, "stated": scaled(0.95)}, MAP),
    "focal 1.05, indistinguishable": ({"stated": scaled(1.05), "scatter": 0.1}, REJECTED),
    "principal point 12, -12": ({"pose": 1, "stated": shifted(12, -12)}, MAP),
    "lower left corner": (
        {"true": (corner := part(100, 75, 1, 0)), "stated": centred(corner)},
        ESTIMATED._replace(metres=0.0099),
    ),
    "left part, 120 columns fewer": (
        {"true": (half := part(120, 0, 1)), "stated": centred(half)},
        Right("estimated", metres=0.03, degrees=1.5),
    ),
    "right part, approximate, 35 columns fewer": (
        {"true": (half := part(35, 0, 0)), "stated": centred(half, 1.05), "approximate": True},
        Right("estimated", metres=0.03, degrees=1.5),
    ),
    "middle": ({"true": part(120, 90)}, Right(metres=0.01, degrees=0.18)),
    "resized 1.33": ({"pose": 1, "stated": resized(1.33)}, MAP),
    "resized 1.33, unknown cameras": ({"stated": resized(1.33), "known": False}, REJECTED),
    "resized 0.95, moving rows": (
        {"stated": resized(0.95), "motion": SLIGHT},
        Right("map", None, 0.0082, 0.25),
    ),
    "another camera, 5 % narrower, moving rows": (
        {"true": resized(1.05), "motion": SLIGHT},
        Right("given", None, 0.0082),
    ),
    "another camera 1.05": ({"pose": 1, "true": scaled(1.05)}, Right()),
    "focal 1.02, unknown cameras": ({"stated": scaled(1.02), "known": False}, ESTIMATED._replace(camera="given")),
    "focal 1.2, unknown cameras": ({"stated": scaled(1.2), "known": False}, ESTIMATED),
    "approximate 0.7, unknown cameras": (
        {"pose": 1, "stated": scaled(0.7), "approximate": True, "known": False},
        Right("estimated", False, 0.031),
    ),
    "approximate 1.4, unknown cameras": (
        {"pose": 1, "stated": scaled(1.4), "approximate": True, "known": False},
        Right("estimated", False, 0.031),
    ),
    "approximate 1.15": ({"stated": scaled(1.15), "approximate": True}, MAP),
    "approximate 1.1, most keypoints wrong": (
        {"stated": scaled(1.1), "approximate": True, "wrong": 0.8},
        Right("map", None, 0.02, 0.5),
    ),
    "approximate 1.1, most keypoints wrong, unknown cameras": (
        {"stated": scaled(1.1), "approximate": True, "wrong": 0.8, "known": False},
        Right("estimated", None, 0.05, 0.8),
    ),
    "approximate, another camera 1.2": (
        {"pose": 1, "true": scaled(1.2), "stated": scaled(1.0), "approximate": True},
        Right("estimated", False, 0.026),
    ),
    "moving rows": ({"motion": MOTION}, MOVED),
    "moving rows, focal 0.95": ({"motion": MOTION, "stated": scaled(0.95)}, MOVED._replace(camera="map")),
    "two rooms": ({"repeated": 1.0}, Outcome.AMBIGUOUS),
    "two rooms, start": ({"pose": 1, "repeated": 1.0, "start": near(POSES[1])}, Right()),
    "two rooms, start in the other": (
        {"pose": 1, "repeated": 1.0, "start": near(COPY @ POSES[1]), "elsewhere": True},
        Right(),
    ),
    "two rooms that share little": ({"repeated": 0.4}, Right()),
    "two thirds of the keypoints wrong": ({"wrong": 0.67}, Right(metres=0.018, degrees=0.32)),
    "only wrong keypoints": ({"wrong": 1.0}, REJECTED),
    "hidden but for the left third": ({"pose": 1, "visible": 0.33}, MAY_BE_REJECTED),
    "12 keypoints": ({"most": 12}, REJECTED),
    "30 keypoints": ({"pose": 1, "most": 30}, Right(metres=0.014, degrees=0.27)),
    "rig": ({"others": POSES[1:2]}, Right()),
    "rig, focal 0.95": ({"pose": 1, "others": POSES[:1], "stated": scaled(0.95)}, MAP),
    "poster from near": ({"flat": True, "at": looking_in(0.5)}, MAY_BE_REJECTED),
    "poster from afar": ({"flat": True, "at": looking_in(0.5, 0.3, 8.0)}, MAY_BE_REJECTED),
    "lens of the map, not stated": (
        {"true": (lens := replace(PINHOLE, distortion=(-0.1, 0.0, 0.0, 0.0))), "stated": PINHOLE, "known": False},
        ESTIMATED,
    ),
    "sheared": ({"true": PINHOLE, "sheared": 0.1, "known": False}, REJECTED),
}


@pytest.mark.parametrize("name", POINTS)
def test_points(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is rendered."""
    condition, expected = POINTS[name]
    usual = {
        "pose": 0,
        "flat": False,
        "known": True,
        "repeated": 0.0,
        "others": (),
        "start": None,
        "sheared": 0.0,
    }
    query = usual | condition
    flat, pose, start, shear = (query.pop(key) for key in ("flat", "pose", "start", "sheared"))
    seen, truth = points(flat), query.pop("at", POSES[pose])
    monkeypatch.setitem(registered, ("features", "points"), seen)
    landmarks = replace(point_landmarks(flat), features="points")
    if not query.pop("known"):
        landmarks = replace(landmarks, cameras=())
    if scatter := query.pop("scatter", None):
        apparent = torch.cat([torch.tensor([scatter]).double(), landmarks.calibration_scatter[1:]])
        landmarks = replace(landmarks, calibration_scatter=apparent)
    if share := query.pop("repeated"):
        landmarks = twice(landmarks, share)
    answered = COPY @ truth if query.pop("elsewhere", False) else truth
    places = [*query.pop("others"), truth]
    views = [point_view(seen, T, seed=100 * pose + number, **query) for number, T in enumerate(places)]
    if shear:
        across, down = seen.seen[-1].pixels.unbind(-1)
        moved = torch.stack([across + shear * (down - PINHOLE.cy), down], -1)
        inside = (moved[:, 0] > 0) & (moved[:, 0] < PINHOLE.width)
        seen.seen[-1] = replace(seen.seen[-1], pixels=moved)[inside]
    # Where landmarks do not convince, the ground is searched for what is not there.
    found = Localizer(with_landmarks(landmarks), config=NOT_RENDERED, warm_up=False)(views, start)
    assert_as_expected(found, answered, expected, query.get("true", PINHOLE))


def noisy(fault: str, depth: bool = False, number: int = 1, *others: int) -> dict[str, Any]:
    return {"views": ground_views(fault, (*others, number), depth)}


SHARP = AutoConfig(fused_rays=1024)
GROUND: dict[str, tuple[Any, Expected]] = {
    "as stated, RGB": (lambda: noisy("none"), Right(metres=0.0075, degrees=0.18)),
    "as stated, RGB-D": (lambda: noisy("none", True), Right(metres=0.0075, degrees=0.18)),
    "focal 0.95, RGB-D": (lambda: noisy("focal:0.95", True), MAP._replace(degrees=0.18)),
    "occluder, RGB-D": (lambda: noisy("occluder:0.25", True), Right(metres=0.0085, degrees=0.18)),
    "principal point": (lambda: noisy("principal-point:5", False, 2), Right("map", False, 0.012, 0.32)),
    "stretched": (lambda: noisy("stretch:1.33"), MAP._replace(degrees=0.18)),
    "nominal, 1.1": (lambda: noisy("nominal+focal:1.1"), Right(None, metres=0.04, degrees=0.6)),
    "moving rows": (lambda: noisy("rolling-shutter:2"), Right("given", True, 0.022, 0.69)),
    "mirrored": (lambda: noisy("mirror"), Outcome.MIRRORED),
    "blurred 1": (lambda: noisy("blur:1", number=2), Right(metres=0.011, degrees=0.32)),
    "another ground": (lambda: {"views": ground_views("none", seed=5)}, REJECTED),
    "halves of two photos": (lambda: collage(2, slice(None), slice(80, None)), Outcome.AMBIGUOUS),
    "inlaid photo": (lambda: collage(0, slice(30, 95), slice(40, 128)), Outcome.AMBIGUOUS),
    "rig": (lambda: noisy("none", False, 1, 0), Right(metres=0.0058, degrees=0.12)),
    "depth 5 % too long": (lambda: noisy("depth-scale:1.05", True), Right(metres=0.0077, degrees=0.18)),
    "focal 0.5, not rendered": (
        lambda: {
            "views": restated(unseen(), 0.5),
            "config": NOT_RENDERED,
            # Of surer cameras; their keypoints are as correlated as those of the map's images.
            "landmarks": replace(
                ground_landmarks(scatter=0.003), correlation=require(textured_map().landmarks).correlation
            ),
        },
        MAP._replace(metres=0.03, degrees=1.0),
    ),
    "focal 1.02, not rendered": (
        lambda: {"views": restated(unseen(), 1.02), "config": NOT_RENDERED},
        Right(None, metres=0.04, degrees=0.6),
    ),
    "focal 1.02, rendered": (
        lambda: {"views": restated(unseen(), 1.02), "config": SHARP},
        MAP._replace(metres=0.02),
    ),
    "another camera 0.97, rendered": (
        lambda: {
            "views": restated(textured_view(GROUND_POSES[1], camera=scaled(0.97, GROUND_CAMERA)), 1.0),
            "config": SHARP,
        },
        Right(metres=0.02),
    ),
}


@pytest.mark.parametrize("name", GROUND)
def test_ground(name: str) -> None:
    make, expected = GROUND[name]
    query = make()
    scene = with_landmarks(query.get("landmarks") or ground_landmarks())
    found = Localizer(scene, config=query.get("config", QUICK), warm_up=False)(query["views"])
    truth, camera = query["views"][-1].T_ref_camera, GROUND_CAMERA
    assert_as_expected(found, truth, expected, camera)


# What is fused with landmarks, and how it shows


TRUTH = unseen().T_ref_camera


@functools.cache
def matcher() -> LandmarkMatcher:
    return LandmarkMatcher(replace(ground_landmarks(), cameras=()))


def solved(*views: View, rays: int = 0, matching: LandmarkMatcher | None = None, **changes: Any) -> LandmarkAnswer:
    scene = replace(textured_map(surface=True), **changes)
    matching = (matching or matcher()).for_query()
    problem = rig(scene, views, None, matcher=matching)
    return require(Loop(problem.views, matching, problem, rays)())


@functools.cache
def alone() -> LandmarkAnswer:
    return solved(colour_only(unseen()))


@pytest.mark.parametrize(("depth", "rays"), [(True, 0), (False, 256), (True, 256)], ids=["depth", "rays", "both"])
def test_each_further_measurement_brings_the_pose_nearer_and_makes_it_more_certain(depth: bool, rays: int) -> None:
    found = solved(unseen() if depth else colour_only(unseen()), rays=rays)
    assert ("depth" in found.fused) is depth
    assert alone().fused == ()
    before, after = (pose_error(each.T_world_rig, TRUTH).translation for each in (alone(), found))
    assert after < 1.001 * before  # landmarks alone are off by a tenth of their standard deviation
    assert_covered(found.T_world_rig, TRUTH, found.covariance)
    for axes in (slice(0, 3), slice(3, 6)):  # position, rotation
        assert float(found.covariance[axes, axes].trace()) < float(alone().covariance[axes, axes].trace())
    torch.testing.assert_close(found.covariance, found.covariance.mT)
    assert float(torch.linalg.eigvalsh(found.covariance)[0]) > 0


@pytest.mark.parametrize("gain", [0.5, 1.6])
def test_another_exposure_does_not_mislead_rendering(gain: float) -> None:
    """Half of the exposure, or one at which bright colours are clipped."""
    view = colour_only(unseen())
    found = solved(replace(view, frame=replace(view.frame, rgb=(gain * view.frame.rgb).clamp(max=1))), rays=256)
    assert "rendering" in found.fused
    assert_near(found.T_world_rig, TRUTH, 0.005, 0.1)


@pytest.mark.parametrize(("noise", "fused"), [(None, True), (0.04, True), (0.041, False)])
def test_a_blurred_field_is_not_rendered(noise: float | None, fused: bool) -> None:
    assert ("rendering" in solved(colour_only(unseen()), rays=256, colour_noise=noise).fused) is fused


@pytest.mark.parametrize("scale", [0.001, 0.3048, 0.8, 1.2])
def test_depth_of_another_unit_does_not_mislead(scale: float) -> None:
    """Millimetres, or feet, read as metres."""
    depth = require(unseen().frame.depth)
    found = solved(replace(unseen(), frame=replace(unseen().frame, depth=scale * depth)), rays=256)
    error = pose_error(found.T_world_rig, TRUTH)
    assert not found.verdict.accepted or float(error.translation) < 0.015


def test_errors_of_the_maps_own_poses_do_not_become_smaller_by_fusion() -> None:
    errors = 1e-4 * torch.eye(6, dtype=torch.float64)
    known = LandmarkMatcher(replace(matcher().landmarks, pose_covariance=errors))
    found = solved(unseen(), rays=256, matching=known)
    assert float(torch.linalg.eigvalsh(found.covariance - errors)[0]) > 0


# Poses found by other means


def test_a_pose_found_by_other_means_is_confirmed_or_contradicted() -> None:
    view, matching = colour_only(unseen()), matcher().for_query()
    problem = rig(textured_map(), [view], None, matcher=matching)
    loop = Loop(problem.views, matching, problem)
    near_truth = TRUTH.retract(torch.tensor([0.01, -0.01, 0.01, 0.005, 0.0, 0.005], dtype=torch.float64))
    there = require(loop.at(near_truth))
    assert there.verdict.accepted
    assert_near(there.T_world_rig, TRUTH, 0.02, 0.5)
    wrong = loop.at(TRUTH.retract(torch.tensor([0.3, 0.2, 0.0, 0.0, 0.0, 0.8], dtype=torch.float64)))
    assert wrong is None or not wrong.verdict.accepted


def landmark_loop() -> Loop:
    matching = matcher().for_query()
    problem = rig(textured_map(), [colour_only(unseen())], None, matcher=matching)
    return Loop(problem.views, matching, problem)


def test_a_pose_that_is_expected_of_any_image_is_not_refined() -> None:
    loop = landmark_loop()
    proposal, nearest = proposal_at("landmarks", TRUTH, loop.landmarks), loop.nearest(STRONGEST)
    assert loop.answer(proposal, nearest, 0.1) is None
    assert require(loop.answer(proposal, nearest, -0.1)).verdict.accepted


class Empty(TexturedGround):
    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        return FieldValues(torch.zeros_like(positions[..., 0]), torch.zeros_like(positions))


@pytest.mark.parametrize("second", [0, 3, 5])
@pytest.mark.parametrize("part", [(slice(None), slice(64, None)), (slice(48, None), slice(None))], ids=["side", "top"])
def test_two_photos_in_one_image_are_two_views(part: tuple[slice, slice], second: int) -> None:
    first, other = unseen().frame.replace(depth=None), training_views()[second].frame
    rgb = first.rgb.clone()
    rgb[part] = other.rgb[part]
    localizer = Localizer(textured_map(), warm_up=False)
    assert localizer(first).converged
    found = localizer(first.replace(rgb=rgb))
    assert found.outcome is Outcome.AMBIGUOUS, found.reason
    assert "the image shows two views" in found.reason
    mean = localizer(first.replace(rgb=(first.rgb + other.rgb) / 2))
    assert not mean.converged, mean.reason


@pytest.mark.parametrize("alike", [True, False])
def test_all_rays_are_rendered_only_where_few_do_not_show_two_places_alike(
    alike: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy of the ground is outside of the field; an empty field shows both alike."""
    module, counts = import_module("bidnerf_core.localization.loop"), list[int]()
    fit = module.fit_with_rays

    def counted(best: Any, terms: Any, rays: Any, *others: Any) -> Any:
        counts.append(len(rays))
        return fit(best, terms, rays, *others)

    monkeypatch.setattr(module, "fit_with_rays", counted)
    ground, T = replace(ground_landmarks(), cameras=()), COPY.to(dtype=torch.float32)
    copy = replace(ground, positions=T.apply(ground.positions), directions=T.rotate(ground.directions))
    field = Empty() if alike else TexturedGround()
    found = solved(colour_only(unseen()), rays=512, matching=LandmarkMatcher(concatenate([ground, copy])), field=field)
    assert set(counts) == ({256} if alike else {256, 512})
    assert found.verdict.outcome is (Outcome.AMBIGUOUS if alike else Outcome.CONVERGED)


def test_another_place_competes_with_the_places_that_look_like_it_not_like_the_first() -> None:
    """The first pose, in a room that shares little, is not the most probable one; that one is in either of two equal rooms."""
    seen, rooms, T = points(), twice(point_landmarks()), COPY @ COPY
    few, elsewhere = point_landmarks()[torch.arange(120)], T.to(dtype=torch.float32)
    noise = 20 * torch.randn(few.descriptors.shape, generator=torch.Generator().manual_seed(1))
    few = replace(
        few,
        positions=elsewhere.apply(few.positions),
        directions=elsewhere.rotate(few.directions),
        descriptors=(few.descriptors + noise).round().clamp(0, 255).byte(),
    )
    matching = LandmarkMatcher(concatenate([rooms, few]))
    loop = Loop([point_view(seen, POSES[0])], matching, features=seen)
    proposal = proposal_at("landmarks", T, few)
    found = require(loop.answer(proposal, loop.nearest(STRONGEST), -10.0))
    assert found.verdict.outcome is Outcome.AMBIGUOUS


# One image, once


def test_a_query_detects_its_keypoints_once_and_its_mirror_image_not_at_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    detector = CountedDetector()
    monkeypatch.setitem(registered, ("features", "counted"), detector)
    scene = with_landmarks(ground_landmarks("counted"))
    for fault in ("none", "mirror"):
        detector.images.clear()
        Localizer(scene, config=NOT_RENDERED, warm_up=False)(ground_views(fault))
        assert len(detector.images) == 1


class Unrendered(TexturedGround):
    """A field that must not be rendered."""

    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        raise AssertionError("rendered")


@pytest.mark.parametrize("fault", ["covered", "blank"])
def test_an_image_that_shows_nothing_is_rejected_without_rendering(fault: str) -> None:
    blank = torch.full_like(unseen().frame.rgb, 0.5)
    frame = replace(unseen().frame, rgb=blank, depth=None)
    view = View(frame, TRUTH) if fault == "blank" else faulty(colour_only(ground_view(1)), "covered", 0)
    scene = replace(with_landmarks(ground_landmarks()), field=Unrendered())
    found = Localizer(scene, warm_up=False)(view)
    assert not found.converged
    assert found.reason


def test_in_a_moved_world_the_answer_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, T = points(), SE3.exp(torch.tensor([3.0, -1.0, 2.0, 0.5, 1.0, -0.3], dtype=torch.float64))
    view, known = point_view(seen, POSES[0]), point_landmarks()
    moved = replace(
        known,
        positions=T.apply(known.positions.double()).float(),
        directions=T.rotate(known.directions.double()).float(),
    )
    here, there = (Loop([view], LandmarkMatcher(each), features=seen)() for each in (known, moved))
    assert_near(require(there).T_world_rig, T @ require(here).T_world_rig, 1e-3, 0.02)


def test_images_of_different_cameras_are_localized_with_the_stated_ones() -> None:
    first, second = training_views()[0], unseen()
    other = textured_view(first.T_ref_camera, camera=scaled(0.8, GROUND_CAMERA))
    found = Localizer(with_landmarks(ground_landmarks()), config=NOT_RENDERED)(
        [colour_only(other), colour_only(second)]
    )
    assert found.converged, found.reason
    assert found.intrinsics is None
    assert_near(found.T_world_camera, TRUTH, 0.01, 0.3)


# Degenerate input


@dataclass(frozen=True)
class Degenerate:
    """Landmarks and keypoints that leave a pose undetermined."""

    keypoints: int | None = None
    landmarks: int | None = None
    squeezed: tuple[float, float, float] = (1.0, 1.0, 1.0)  # factors of the landmarks' positions
    far: float = 0.0  # metres: from the landmarks to where they seem to be


DEGENERATE = {
    "no landmarks": Degenerate(landmarks=0),
    "5 landmarks": Degenerate(landmarks=5),
    "7 keypoints": Degenerate(keypoints=7),
    "no keypoints": Degenerate(keypoints=0),
    "coplanar": Degenerate(squeezed=(1.0, 1.0, 0.0)),
    "collinear": Degenerate(squeezed=(1.0, 0.0, 0.0)),
    "one point": Degenerate(squeezed=(0.0, 0.0, 0.0)),
    "far": Degenerate(far=1e7),
    "overflowing": Degenerate(squeezed=(0.0, 0.0, 0.0), far=3e38),
}


@pytest.mark.parametrize(
    ("name", "start"),
    [
        *((name, None) for name in DEGENERATE),
        *((name, POSES[0]) for name in ("5 landmarks", "no keypoints", "collinear")),
    ],
)
def test_degenerate_input_has_a_finite_answer_that_is_not_accepted_or_none(name: str, start: SE3 | None) -> None:
    given, seen, known = DEGENERATE[name], points(), point_landmarks()[slice(0, DEGENERATE[name].landmarks)]
    factors = torch.tensor(given.squeezed)
    view = point_view(seen, POSES[0], most=given.keypoints)
    matching = LandmarkMatcher(replace(known, positions=known.positions * factors + given.far))
    problem = rig(with_landmarks(known), [view], start, matcher=matching)
    found = Loop(problem.views, matching, problem, features=seen)()
    if found is None:
        return
    assert not found.verdict.accepted or name == "coplanar"
    assert bool(found.T_world_rig.matrix().isfinite().all())
    assert bool(found.posterior.probability.isfinite().all())
    assert not bool(found.covariance.isnan().any())


def test_the_same_seed_gives_the_same_answer_in_any_thread() -> None:
    localize = Localizer(with_landmarks(ground_landmarks()), config=QUICK, warm_up=False)
    views = [ground_views("none", depth=True), ground_views("focal:0.95")]
    expected = [localize(view, seed=3) for view in views]
    torch.manual_seed(99)
    with ThreadPoolExecutor(2) as pool:
        again = list(pool.map(lambda view: localize(view, seed=3), views))
    for one, other in zip(expected, again, strict=True):
        assert torch.equal(one.T_world_camera.matrix(), other.T_world_camera.matrix())
        assert torch.equal(require(one.covariance), require(other.covariance))
        assert (one.outcome, one.reason) == (other.outcome, other.reason)


@pytest.mark.parametrize("degrees", [0.0, 2.0, 5.0, 10.0])
def test_a_start_is_searched_as_far_as_its_errors_reach(monkeypatch: pytest.MonkeyPatch, degrees: float) -> None:
    """Where the whole map has no consensus, as in a scene that looks alike everywhere."""
    monkeypatch.setattr("bidnerf_core.localization.loop.best_consensus", lambda *_: None)
    view, off = unseen(), torch.zeros(6, dtype=torch.float64)
    off[3:] = math.radians(degrees) * torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    off[:3] = 0.1 * degrees / 10
    found = Localizer(textured_map())(view.frame.replace(depth=None), view.T_ref_camera.retract(off))
    assert found.converged, found.reason
    assert_near(found.T_world_camera, view.T_ref_camera, 0.03, 1.0)
