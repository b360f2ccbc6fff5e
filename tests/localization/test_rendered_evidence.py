"""Evidence by renderings: which of two cameras took an image, and whether it is mirrored, where keypoints do not tell."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core import Intrinsics, Localizer, Outcome, View
from bidnerf_core.fields import FieldValues
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import (
    AutoConfig,
    LandmarkAnswer,
    LandmarkDiagnostics,
    LandmarkMatcher,
    Problem,
    answer_by_landmarks,
    mirror_image,
    rig,
)
from bidnerf_core.localization.alternatives import NOISIEST, decide, log_odds_by_rendering
from bidnerf_core.results import pose_error
from bidnerf_core.testing import CAMERA, TexturedGround, seen, textured_map, unseen


def stated(factor: float) -> Intrinsics:
    return replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)


def problem(camera: Intrinsics = CAMERA, mirrored: bool = False) -> Problem:
    """An image of the ground as seen with a camera, from about the pose that suits it best."""
    view = unseen()
    frame = replace(view.frame, intrinsics=camera)
    distance = float(view.T_ref_camera.translation.norm())
    nearer = torch.tensor([0, 0, distance * (1 - camera.fx / CAMERA.fx), 0, 0, 0], dtype=torch.float64)
    start = view.T_ref_camera.retract(nearer)
    return rig(
        textured_map(), [View(mirror_image(frame) if mirrored else frame, SE3.identity())], start
    ).without_depth()


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_the_camera_that_took_the_image_is_told_from_another(factor: float) -> None:
    assert log_odds_by_rendering(problem(), problem(stated(factor)), seed=0) > 3


def test_the_odds_of_one_are_those_against_the_other() -> None:
    a, b = problem(), problem(stated(1.01))
    assert log_odds_by_rendering(a, b, seed=0) == pytest.approx(-log_odds_by_rendering(b, a, seed=0))
    assert log_odds_by_rendering(a, a, seed=0) == 0


def test_more_rays_than_pixels_tell_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    enough = log_odds_by_rendering(problem(), problem(stated(1.03)), seed=0)
    rows = torch.ones((CAMERA.height, CAMERA.width), dtype=torch.bool)
    rows[:8] = False  # a twelfth of the image is left

    def hidden(given: Problem) -> Problem:
        (view,) = given.views
        return replace(given, views=(replace(view, frame=replace(view.frame, hidden=rows)),))

    few = [hidden(problem()), hidden(problem(stated(1.03)))]
    told = log_odds_by_rendering(*few, seed=0)
    monkeypatch.setattr("bidnerf_core.localization.alternatives.COMPARED_RAYS", 100_000)
    assert log_odds_by_rendering(*few, seed=0) == told
    assert told < 0.6 * enough


class NotFinite(TexturedGround):
    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        values = super().query(positions, directions)
        return replace(values, rgb=values.rgb * torch.nan)


def test_a_field_that_renders_what_is_not_finite_tells_nothing() -> None:
    a, b = (replace(given, field=NotFinite()) for given in (problem(), problem(stated(1.03))))
    assert log_odds_by_rendering(a, b, seed=0) == 0


def test_a_field_that_has_hardly_been_trained_tells_nothing() -> None:
    a, b = (replace(given, colour_noise=1.01 * NOISIEST) for given in (problem(), problem(stated(1.03))))
    assert log_odds_by_rendering(a, b, seed=0) == 0
    c, d = (replace(given, colour_noise=0.99 * NOISIEST) for given in (a, b))
    assert log_odds_by_rendering(c, d, seed=0) > 1


def test_an_image_is_told_from_its_mirror_image() -> None:
    assert log_odds_by_rendering(problem(), problem(mirrored=True), seed=0) > 5


def test_exposure_does_not_change_what_an_image_tells() -> None:
    def darker(given: Problem) -> Problem:
        return replace(
            given,
            views=tuple(replace(v, frame=replace(v.frame, rgb=0.7 * v.frame.rgb)) for v in given.views),
        )

    assert log_odds_by_rendering(darker(problem()), darker(problem(stated(1.03))), seed=0) > 3


def answered(
    view: View, rays: int, cameras: tuple[Intrinsics, ...] = (CAMERA,), scatter: float = 0.01
) -> LandmarkAnswer:
    """Localize with a map whose own images hardly tell which focal length is right: estimates from them ``scatter``."""
    landmarks = textured_map().landmarks
    assert landmarks is not None
    deviations = torch.full((4,), scatter, dtype=torch.float64)
    matcher = LandmarkMatcher(
        replace(landmarks, calibration_scatter=deviations, correlation=1.0, cameras=cameras)
    )
    photo = replace(view, frame=replace(view.frame, depth=None))
    found = answer_by_landmarks(rig(textured_map(), [photo], None, matcher=matcher), matcher, rays, seed=0)
    assert found is not None
    return found


@pytest.mark.parametrize("factor", [1.02, 1.03])
def test_renderings_recognise_the_maps_camera_where_keypoints_do_not(factor: float) -> None:
    view = unseen()
    misstated = replace(view, frame=replace(view.frame, intrinsics=stated(factor)))
    assert answered(misstated, rays=0).verdict.outcome is Outcome.MISCALIBRATED
    found = answered(misstated, rays=1024)
    assert found.verdict.accepted
    assert found.found.takes_map_camera
    assert float(pose_error(found.T, view.T_ref_camera).translation) < 0.005


@pytest.mark.parametrize("factor", [0.96, 0.97, 1.015])
def test_renderings_recognise_another_camera_that_is_stated_rightly(factor: float) -> None:
    other = seen(unseen().T_ref_camera, stated(factor))
    assert answered(other, rays=0).verdict.outcome is Outcome.MISCALIBRATED
    found = answered(other, rays=1024)
    assert found.verdict.accepted
    assert not found.found.takes_map_camera
    assert float(pose_error(found.T, other.T_ref_camera).translation) < 0.005


def test_intrinsics_that_renderings_contradict_are_estimated() -> None:
    """The map does not say which cameras took its images, so that there is no other hypothesis."""
    view = unseen()
    misstated = replace(view, frame=replace(view.frame, intrinsics=stated(1.08)))
    assert answered(misstated, rays=0, cameras=(), scatter=0.007).verdict.outcome is Outcome.MISCALIBRATED
    found = answered(misstated, rays=1024, cameras=(), scatter=0.007)
    assert found.verdict.outcome is not Outcome.MISCALIBRATED
    assert found.found.estimates_calibration
    assert found.found.focal_factor == pytest.approx(1 / 1.08, rel=0.03)


def test_a_mirrored_image_stays_rejected_where_renderings_are_compared() -> None:
    view, landmarks = View(replace(unseen().frame, depth=None), SE3.identity()), textured_map().landmarks
    assert landmarks is not None
    mirrored = replace(view, frame=mirror_image(view.frame))
    problem = rig(textured_map(), [mirrored], None, matcher=LandmarkMatcher(landmarks))
    rejection = decide(problem, unseen().T_ref_camera, None, rays=1024, seed=0).rejection
    assert rejection is not None
    assert rejection.outcome is Outcome.MIRRORED


@pytest.mark.slow
@pytest.mark.parametrize(("rays", "expected"), [(1024, Outcome.CONVERGED), (0, Outcome.AMBIGUOUS)])
def test_renderings_decide_where_keypoints_do_not_tell_an_image_from_its_mirror_image(
    rays: int, expected: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mirror image is made to match as many landmarks as the image, and the mirror image's pose is the best there is."""
    localizer = Localizer(textured_map(surface=True), "auto", AutoConfig(fused_rays=rays))
    frame = replace(unseen().frame, depth=None)
    known = localizer(frame).diagnostics
    assert isinstance(known, LandmarkDiagnostics)
    monkeypatch.setattr("bidnerf_core.localization.alternatives.UNMISTAKABLE", -1e6)
    monkeypatch.setattr(
        "bidnerf_core.localization.alternatives.mirror_evidence", lambda *_: (known.agreeing, known.log10_nfa)
    )
    assert localizer(frame).outcome is expected
