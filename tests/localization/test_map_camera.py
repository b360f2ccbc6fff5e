"""The cameras of a map's images as an alternative to the intrinsics that a query states."""

from __future__ import annotations

import math
from dataclasses import astuple, replace
from typing import Any

import pytest
import torch

from bidnerf_core import SE3, Frame, Intrinsics, View
from bidnerf_core.localization import (
    LandmarkMatcher,
    LandmarkPose,
    LandmarkThresholds,
    Outcome,
    Stated,
    Whose,
    landmark_verdict,
    propose,
)
from bidnerf_core.localization.landmarks.correspondences import LandmarkMatches
from bidnerf_core.localization.landmarks.map_camera import (
    SHARE_SAME_CAMERA,
    MapCamera,
    correction_between,
    map_cameras,
)
from bidnerf_core.localization.landmarks.matching import unguided_matches
from bidnerf_core.localization.landmarks.propose import updated
from bidnerf_core.mapping import GIVEN, NOMINAL, Calibration, LandmarkMap, build_landmarks
from landmark_scene import PINHOLE, Points, looking_in, ring

TRUE = looking_in(0.43, 0.45, 3.6)
NOISE = 0.3  # pixels


@pytest.fixture(scope="module")
def landmarks() -> LandmarkMap:
    points = Points()
    scatter = torch.full((4,), 1e-3, dtype=torch.float64)
    built = build_landmarks(ring(points), points)
    return replace(built, cameras=(PINHOLE,), correlation=1.0, calibration_scatter=scatter)


def with_focal(factor: float, camera: Intrinsics = PINHOLE) -> Intrinsics:
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)


def localized(landmarks: LandmarkMap, stated: Intrinsics, true: Intrinsics = PINHOLE) -> LandmarkPose:
    """The answer to an image of a ``true`` camera that is stated otherwise."""
    points = Points(noise=NOISE)
    view = points.view(TRUE, true)
    found = propose(
        LandmarkMatcher(landmarks), [replace(view, frame=replace(view.frame, intrinsics=stated))], points
    )
    assert found is not None
    return found


def map_camera(given: Intrinsics, cameras: tuple[Intrinsics, ...]) -> MapCamera | None:
    """The one camera of a map whose images have one shape."""
    found = map_cameras(given, cameras)
    assert len(found) <= 1
    return found[0] if found else None


def error(found: LandmarkPose) -> float:
    return float((found.T_world_camera.inverse() @ TRUE).log().norm())


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


@pytest.mark.parametrize("factor", [0.95, 0.98, 1.02, 1.05])
def test_a_misstated_camera_of_the_map_is_recognised(landmarks: LandmarkMap, factor: float) -> None:
    right, corrected = localized(landmarks, PINHOLE), localized(landmarks, with_focal(factor))
    assert corrected.takes_map_camera
    assert corrected.intrinsics == PINHOLE
    assert corrected.focal_factor == pytest.approx(1 / factor, rel=1e-6)
    assert error(corrected) < 1.5 * error(right) + 0.002
    verdict = landmark_verdict(corrected)
    assert verdict.accepted
    assert "with the map's intrinsics: a focal length" in verdict.reason


def test_without_the_maps_cameras_the_stated_one_misleads(landmarks: LandmarkMap) -> None:
    vague = replace(landmarks, calibration_scatter=10 * landmarks.calibration_scatter)
    found = localized(replace(vague, cameras=()), with_focal(1.02))
    assert not found.takes_map_camera
    assert error(found) > 0.04
    assert error(localized(vague, with_focal(1.02))) < 0.01


@pytest.mark.parametrize("factor", [0.95, 1.04])
def test_the_intrinsics_of_another_camera_are_kept(landmarks: LandmarkMap, factor: float) -> None:
    other = with_focal(factor)
    found = localized(landmarks, other, other)
    assert not found.takes_map_camera
    assert error(found) < 0.02
    assert landmark_verdict(found).accepted


def test_intrinsics_that_the_image_cannot_tell_apart_are_not_accepted(landmarks: LandmarkMap) -> None:
    """The scatter of apparent focal lengths in the map is far larger than the difference."""
    scatter = landmarks.calibration_scatter.clone()
    scatter[0] = 0.1
    found = localized(replace(landmarks, calibration_scatter=scatter), with_focal(1.05))
    verdict = landmark_verdict(found)
    assert verdict.outcome is Outcome.MISCALIBRATED
    assert "do not show whether" in verdict.reason
    assert found.guided is not None
    other = found.guided.posterior.riskiest
    assert other is not None
    shift = found.guided.posterior.shift(other)
    assert float(shift[:3].norm()) > 0.02
    assert found.relative_shift > LandmarkThresholds().relative_shift
    # The covariance contains the pose with the other intrinsics.
    assert float(shift @ torch.linalg.solve(found.full_covariance, shift)) < 16.8
    indifferent = LandmarkThresholds(relative_shift=1.0)
    assert landmark_verdict(found, indifferent).outcome is not Outcome.MISCALIBRATED


def with_log_odds(found: LandmarkPose, whose: Whose, odds: float) -> LandmarkPose:
    assert found.guided is not None
    every = [e.hypothesis for e in found.guided.posterior.explanations]
    return updated(found, {h.group: odds for h in every if h.whose is whose and h.group != Stated.EXACT})


@pytest.mark.parametrize("odds", [-20.0, 20.0])
def test_what_else_is_known_of_the_camera_decides_where_the_image_does_not(
    odds: float, landmarks: LandmarkMap
) -> None:
    scatter = landmarks.calibration_scatter.clone()
    scatter[0] = 0.1
    vague, points = replace(landmarks, calibration_scatter=scatter), Points(noise=NOISE)
    view = points.view(TRUE)
    stated = replace(view, frame=replace(view.frame, intrinsics=with_focal(1.05)))
    found = propose(LandmarkMatcher(vague), [stated], points)
    assert found is not None
    found = with_log_odds(found, Whose.MAP, odds)
    assert found.takes_map_camera is (odds > 0)
    assert landmark_verdict(found).accepted


def test_evidence_against_the_intrinsics_taken_has_them_estimated(landmarks: LandmarkMap) -> None:
    points = Points(noise=NOISE)
    view, strange = points.view(TRUE), replace(landmarks, cameras=())
    stated = replace(view, frame=replace(view.frame, intrinsics=with_focal(1.02)))
    found = propose(LandmarkMatcher(strange), [stated], points)
    assert found is not None
    kept, estimated = (with_log_odds(found, Whose.ESTIMATED, odds) for odds in (-50.0, 50.0))
    assert kept.guided is not None
    assert kept.guided.best.hypothesis.group == Stated.EXACT
    assert estimated.focal_factor == pytest.approx(1 / 1.02, rel=0.005)


def test_a_misplaced_principal_point_is_corrected_too(landmarks: LandmarkMap) -> None:
    found = localized(landmarks, replace(PINHOLE, cx=PINHOLE.cx + 6.0))
    assert found.takes_map_camera
    assert found.calibration.shift_u == pytest.approx(-6 / PINHOLE.fx, rel=1e-6)
    assert error(found) < 0.01


def test_an_approximate_focal_length_becomes_that_of_the_maps_camera(landmarks: LandmarkMap) -> None:
    points = Points(noise=NOISE)
    view = points.view(TRUE)
    stated = View(Frame("f", view.frame.rgb, with_focal(1.1)), SE3.identity())
    found = propose(LandmarkMatcher(landmarks), [stated], points, prior=NOMINAL)
    assert found is not None
    assert found.takes_map_camera
    assert found.focal_factor == pytest.approx(1 / 1.1, rel=1e-6)
    free = propose(LandmarkMatcher(replace(landmarks, cameras=())), [stated], points, prior=NOMINAL)
    assert free is not None
    assert float(found.full_covariance.diagonal()[:3].sum()) < float(
        free.full_covariance.diagonal()[:3].sum()
    )


@pytest.mark.parametrize("known", [True, False], ids=["with the map's cameras", "without"])
def test_an_approximate_focal_length_is_found_among_mostly_wrong_matches(
    landmarks: LandmarkMap, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Samples of four, which tell the focal length, are then hardly ever without a wrong match."""

    def mostly_wrong(*given: Any) -> LandmarkMatches:
        matches = unguided_matches(*given)
        wrong = torch.rand(len(matches), generator=torch.Generator().manual_seed(0)) < 0.87
        landmark = matches.landmark.clone()
        landmark[wrong] = landmark[wrong].roll(1)
        return replace(matches, landmark=landmark)

    monkeypatch.setattr("bidnerf_core.localization.landmarks.propose.unguided_matches", mostly_wrong)
    points = Points(noise=NOISE)
    stated = View(Frame("f", points.view(TRUE).frame.rgb, with_focal(1.1)), SE3.identity())
    matcher = LandmarkMatcher(landmarks if known else replace(landmarks, cameras=()))
    for seed in range(3):
        found = propose(matcher, [stated], points, seed=seed, prior=NOMINAL)
        assert found is not None
        assert error(found) < 0.02
        assert found.takes_map_camera == known


def test_intrinsics_that_are_also_the_maps_are_mistaken_less_often(landmarks: LandmarkMap) -> None:
    """An image of the map's camera that seems to need a correction is trusted more than one of an unknown camera."""
    apparent = with_focal(1.01)
    known, unknown = (
        localized(part, PINHOLE, apparent).doubt.wrong for part in (landmarks, replace(landmarks, cameras=()))
    )
    odds = [p / (1 - p) for p in (known, unknown)]
    assert odds[0] == pytest.approx((1 - SHARE_SAME_CAMERA) * odds[1], rel=0.1)


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
