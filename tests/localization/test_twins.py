"""Scenes that repeat themselves: the second place is found, and no pose is believed unless something tells the two apart."""

from __future__ import annotations

import importlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bidnerf_core import SE3, Localization, Localizer, Outcome, View
from bidnerf_core.fields import render_image
from bidnerf_core.localization import (
    AutoConfig,
    LandmarkMatcher,
    LandmarkPose,
    Problem,
    confirm,
    propose,
    rig,
)
from bidnerf_core.localization.alternatives import Decision, decide
from bidnerf_core.localization.landmarks.chance import log_odds_of_share
from bidnerf_core.localization.tracking.relocalization import relocalized
from bidnerf_core.mapping import LandmarkMap, build_landmarks
from bidnerf_core.results import pose_error
from bidnerf_core.testing import BOUNDS, CAMERA, ground, textured_map, unseen
from landmark_scene import Points, looking_in, ring
from problems import localize

with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    repeated_scene = importlib.import_module("repeated_scene")
twice, DoubledField, copies = (getattr(repeated_scene, name) for name in ("twice", "DoubledField", "copies"))
COPY = SE3.exp(torch.tensor([30.0, 5.0, -20.0, 0.2, -0.9, 0.4], dtype=torch.float64))
POSE = looking_in(0.43, 0.45, 3.6)


def test_a_doubled_field_shows_the_same_at_both_places() -> None:
    truth = unseen().T_ref_camera
    shown = render_image(ground(), CAMERA, truth, BOUNDS)
    for T_world_copy in copies(BOUNDS):
        field = DoubledField(ground(), BOUNDS, T_world_copy)
        for T in (truth, T_world_copy @ truth):
            wide = replace(BOUNDS, lower=(-1e3, -1e3, -1e3), upper=(1e3, 1e3, 1e3))
            there = render_image(field, CAMERA, T, wide)
            torch.testing.assert_close(there.rgb, shown.rgb, atol=0.02, rtol=0)
            torch.testing.assert_close(there.depth, shown.depth, atol=1e-3, rtol=1e-3)


def points_and_landmarks() -> tuple[Points, LandmarkMap]:
    points = Points(noise=0.3)
    return points, build_landmarks(ring(points), points)


@pytest.mark.parametrize("views", [1, 2])
def test_the_twin_is_where_the_copy_shows_the_same(views: int) -> None:
    points, landmarks = points_and_landmarks()
    matcher = LandmarkMatcher(twice(landmarks, COPY))
    places = [looking_in(0.3), POSE][-views:]
    shown = [points.view(T, T_ref_camera=T) for T in places]
    proposed, confirmed = (
        propose(matcher, shown, points, seek_rivals=True),
        confirm(matcher, shown, POSE, points, seek_rivals=True).pose,
    )
    for found in (proposed, confirmed):
        assert found is not None
        (twin,) = found.rivals
        at_copy = pose_error(found.T_world_camera, POSE).translation > 1
        other = POSE if at_copy else COPY @ POSE
        assert pose_error(twin.T_world_rig, other).translation < 0.02
        assert abs(twin.log_odds) < 1.5


@pytest.mark.parametrize(("share", "has_twin"), [(0.0, False), (0.15, False), (0.4, False), (0.8, True)])
def test_a_scene_of_which_little_is_repeated_has_no_twin(share: float, has_twin: bool) -> None:
    points, landmarks = points_and_landmarks()
    matcher = LandmarkMatcher(twice(landmarks, COPY, share))
    found = propose(matcher, [points.view(POSE)], points, seek_rivals=True)
    assert found is not None
    assert pose_error(found.T_world_camera, POSE).translation < 0.02
    assert bool(found.rivals) is has_twin


def ground_twice() -> LandmarkMatcher:
    """The landmarks of the ground at two places; its field is at one of them only."""
    landmarks = textured_map().landmarks
    assert landmarks is not None
    return LandmarkMatcher(twice(landmarks, COPY))


def ground_problem(start: SE3 | None = None) -> Problem:
    photo = View(replace(unseen().frame, depth=None), SE3.identity())
    return rig(textured_map(), [photo], start, matcher=ground_twice())


def both_ways() -> tuple[LandmarkPose, LandmarkPose]:
    """Return the pose at the ground whose twin is at its copy, and the other way round."""
    found = propose(ground_twice(), ground_problem().views, seek_rivals=True)
    assert found is not None
    (twin,) = found.rivals
    rival = replace(twin, T_world_rig=found.T_world_camera, log_odds=-twin.log_odds)
    other = replace(found, T_world_camera=twin.T_world_rig, rivals=(rival,))
    at_copy = pose_error(found.T_world_camera, unseen().T_ref_camera).translation > 1
    return (other, found) if at_copy else (found, other)


def decided(found: LandmarkPose, rays: int) -> Decision:
    return decide(ground_problem(), found.T_world_camera, found, rays, seed=0)


def off_by(T: SE3, metres: float) -> SE3:
    return T.retract(torch.tensor([metres, 0.0, 0.0, 0.2, 0.0, 0.0], dtype=torch.float64))


def assert_right(found: Localization) -> None:
    assert found.converged, found.reason
    assert pose_error(found.T_world_camera, unseen().T_ref_camera).translation < 0.02


def test_keypoints_alone_leave_it_open() -> None:
    found = localize(ground_problem(), "auto", AutoConfig(fused_rays=0))
    assert found.outcome is Outcome.AMBIGUOUS
    assert "the photo fits two places" in found.reason
    assert found.confidence is None


def test_a_start_decides_also_for_the_place_that_was_not_found_first() -> None:
    """One of two equal places is found first, whichever: the start has to bring each answer to its own."""
    truth = unseen().T_ref_camera
    assert_right(localize(ground_problem(off_by(truth, 2.0)), "auto", AutoConfig(fused_rays=0)))
    there = localize(ground_problem(off_by(COPY @ truth, 2.0)), "auto", AutoConfig(fused_rays=0))
    assert there.converged, there.reason
    assert pose_error(there.T_world_camera, COPY @ truth).translation < 0.02


def test_a_start_between_the_places_decides_nothing() -> None:
    here, there = (T.T_world_camera for T in both_ways())
    middle = replace(here, translation=0.5 * (here.translation + there.translation))
    found = localize(ground_problem(middle), "auto", AutoConfig(fused_rays=0))
    assert found.outcome is Outcome.AMBIGUOUS


@pytest.mark.slow
def test_renderings_tell_places_apart_that_look_different() -> None:
    here, there = both_ways()
    assert decided(here, rays=1024).rejection is None
    assert decided(there, rays=1024).better is there.rivals[0]
    assert decided(here, rays=0).rejection is not None
    assert decided(there, rays=0).better is None
    assert_right(localize(ground_problem(), "auto", AutoConfig(fused_rays=256)))


def test_renderings_of_the_same_do_not_tell() -> None:
    here, _ = both_ways()
    (view,) = ground_problem().views
    noise = 0.02 * torch.randn(view.frame.rgb.shape, generator=torch.Generator().manual_seed(0))
    noisy = replace(view, frame=replace(view.frame, rgb=(view.frame.rgb + noise).clamp(0, 1)))
    wide = replace(BOUNDS, lower=(-1e3, -1e3, -1e3), upper=(1e3, 1e3, 1e3))
    twice = replace(ground_problem(), views=(noisy,), field=DoubledField(ground(), BOUNDS, COPY), bounds=wide)
    verdict = decide(twice, here.T_world_camera, here, rays=1024, seed=0).rejection
    assert verdict is not None
    assert verdict.outcome is Outcome.AMBIGUOUS


def test_clearly_more_landmarks_decide_where_nothing_is_rendered() -> None:
    here, _ = both_ways()
    (twin,) = here.rivals
    for share, is_rejected in ((0.6, False), (0.9, True)):
        found = replace(here, rivals=(replace(twin, log_odds=log_odds_of_share(share)),))
        assert (decided(found, rays=0).rejection is not None) is is_rejected


def test_a_pose_by_descent_is_rejected_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a map without a surface, ``auto`` descends from a start where landmarks are not recognised; this one is as far from both places."""
    here, there = (T.T_world_camera for T in both_ways())
    at_truth = localize(ground_problem(off_by(here, 2.0)), "auto", AutoConfig(fused_rays=0))
    monkeypatch.setattr("bidnerf_core.localization.auto.answer_by_landmarks", lambda *_: None)
    monkeypatch.setattr("bidnerf_core.localization.auto.bid", lambda *_: replace(at_truth, diagnostics=None))
    middle = replace(here, translation=0.5 * (here.translation + there.translation))
    found = localize(ground_problem(middle), "auto", AutoConfig(fused_rays=0))
    assert found.outcome is Outcome.AMBIGUOUS
    assert "the photo fits two places" in found.reason
    near = localize(ground_problem(off_by(here, 2.0)), "auto", AutoConfig(fused_rays=0))
    assert_right(near)


def test_a_tracker_does_not_begin_at_either_place_without_a_start() -> None:
    frame, truth = replace(unseen().frame, depth=None), unseen().T_ref_camera
    landmarks = ground_twice().landmarks
    doubled = replace(textured_map(), landmarks=landmarks)
    localizer = Localizer(doubled, "auto", AutoConfig(fused_rays=0))
    lost = relocalized(localizer, frame, None, 0, 0)
    assert lost is not None
    assert not lost.converged
    found = relocalized(localizer, frame, off_by(truth, 2.0), 0, 0)
    assert found is not None
    assert_right(found)
    rendered = relocalized(Localizer(doubled, "auto", AutoConfig()), frame, None, 0, 0)
    assert rendered is not None
    assert_right(rendered)
