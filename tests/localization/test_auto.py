"""Method ``auto``: poses without a start, with one, from depth rays, and where there is no surface or no depth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from unittest.mock import Mock

import pytest
import torch

import baked
import blob_images
import module_fields
from bidnerf import Localizer
from bidnerf.evaluation import faulty
from bidnerf.results import pose_error
from bidnerf.scenes import demo_room
from bidnerf_bid import AdamSettings, BidConfig, DescentSettings
from bidnerf_core.fields import Observations
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, perturb
from bidnerf_core.localization import METHODS, AutoConfig, LandmarkMatcher, Localization, Outcome, Problem, rig
from bidnerf_core.mapping import HeldOutTrial, Keypoints
from bidnerf_core.registry import list_plugins, registered
from conditions import point_landmarks
from localizations import answer, assert_covered, assert_near, colour_only
from problems import FieldMap, localize
from refusals import refused
from tiny import depth_rays_of

QUICK = AutoConfig(points=500, hypotheses=64, refine_steps=0)
"""The field of these tests does not show the toy."""


def found_for(problem: Problem, seed: int = 0) -> Localization:
    return localize(problem, "auto", QUICK, seed)


def assert_right(found: Localization, truth: SE3) -> None:
    assert_near(found.T_world_camera, truth, 0.05, 1)


@pytest.mark.parametrize("number", range(2))
def test_no_start_is_needed(number: int) -> None:
    view = baked.unseen()[number]
    found = found_for(baked.problem(view))
    assert_right(found, view.T_ref_camera)
    assert found.converged, found.reason
    assert found.method == "auto"
    assert found.T_world_camera.rotation.dtype == torch.float64
    assert found.steps == len(found.losses) == len(found.poses.translation) - 1
    assert bool(found.losses.isfinite().all())
    assert_covered(found.T_world_camera, view.T_ref_camera, found.covariance)


@pytest.mark.parametrize("gain", [0.4, 1.5])
def test_another_exposure_is_accepted_by_depth(gain: float) -> None:
    view = baked.unseen()[0]
    exposed = replace(view, frame=replace(view.frame, rgb=(gain * view.frame.rgb).clamp(max=1)))
    found = found_for(baked.problem(exposed))
    assert_right(found, view.T_ref_camera)
    assert found.converged, found.reason


def approximate(view: View) -> View:
    return replace(view, frame=replace(view.frame, focal_is_approximate=True))


def test_measured_points_do_not_tell_an_approximate_focal_length() -> None:
    """A wrong one spreads them, for which a shifted pose partly makes up. The rays of a lidar do not depend on it."""
    view = baked.unseen()[0]
    found = found_for(baked.problem(approximate(view)))
    assert found.outcome is Outcome.IMPRECISE
    assert "the focal length is approximate" in found.reason
    colour = approximate(colour_only(view))
    lidar = rig(FieldMap(baked.FIELD, baked.BOUNDS, baked.toy()), [colour], None, in_camera(view))
    found = found_for(lidar)
    assert_right(found, view.T_ref_camera)
    assert found.converged, found.reason
    assert found.covariance is not None


def test_a_start_helps_where_the_map_has_no_view_alike() -> None:
    view = baked.unseen()[0]
    aside = replace(baked.toy(), keyframes=torch.eye(4, dtype=torch.float64)[None])
    start = perturb(view.T_ref_camera, 0.2, 10, 0)
    found = localize(
        baked.problem(view, start=start, surface=aside),
        "auto",
        AutoConfig(hypotheses=32, rounds=1, refine_steps=0),
    )
    assert_right(found, view.T_ref_camera)
    assert torch.equal(found.poses[0].matrix(), start.matrix())
    assert torch.allclose(found.poses[-1].matrix(), found.T_world_camera.matrix())


def test_a_field_that_does_not_show_the_surface_hardly_moves_the_pose() -> None:
    """Measured points hold the pose on the surface, and the disagreement of the rays rejects it."""
    problem = baked.problem(baked.unseen()[0])
    found = localize(problem, "auto", replace(QUICK, refine_steps=3), 0)
    moved = pose_error(found.T_world_camera, found_for(problem).T_world_camera)
    assert float(moved.translation) < 0.05
    assert float(moved.rotation_deg) < 2.0
    assert not found.converged
    assert found.outcome is Outcome.RENDERING_MISMATCH
    assert "of the rendered rays agree with the measurements" in found.reason


def in_camera(view: View) -> Observations:
    """Return the depth image of a view as rays in the frame of its camera."""
    return depth_rays_of([View(view.frame, SE3.identity())])


def test_depth_rays_of_a_wide_lidar_are_matched_without_colour_where_no_image_sees_them() -> None:
    """A narrow image gives colours to the middle of the scan only; the rest counts by its shape."""
    view = baked.unseen()[0]
    camera = replace(baked.CAMERA, cx=12.0, cy=12.0, width=24, height=24)
    narrow = View(Frame("narrow", view.frame.rgb[24:48, 24:48], camera), view.T_ref_camera)
    rays = in_camera(view)
    start = perturb(view.T_ref_camera, 0.1, 5, 0)
    problem = rig(FieldMap(baked.FIELD, baked.BOUNDS, baked.toy()), [narrow], start, rays)
    assert_right(found_for(problem), view.T_ref_camera)


def test_a_few_depth_rays_are_too_little_to_search_by(monkeypatch: pytest.MonkeyPatch) -> None:
    """The images decide where there are fewer points than a shape needs."""
    by_surface = import_module("bidnerf_core.localization.by_surface")
    monkeypatch.setattr(by_surface, "IMAGE_STAGES", ((16, 0, 4, 0.0), (16, 2, 2, 0.0)))
    view = baked.unseen()[0]
    few = in_camera(view)[:49]
    problem = rig(FieldMap(baked.FIELD, baked.BOUNDS, baked.toy()), [colour_only(view)], None, few)
    quick = {"hypotheses": 8, "rounds": 1, "fine_steps": 1, "fine_rays": 64}
    found = localize(problem, "auto", quick)
    alone = localize(problem.without_depth(), "auto", quick)
    assert torch.equal(found.T_world_camera.matrix(), alone.T_world_camera.matrix())
    assert "newly drawn rays" in found.reason


def test_a_map_without_a_surface_needs_a_start() -> None:
    problem = rig(FieldMap(baked.FIELD, baked.BOUNDS), [baked.unseen()[0]], None)
    with refused(where="the map has no surface", found="method 'auto' then needs a start"):
        found_for(problem)


def test_in_a_map_without_a_surface_it_descends_from_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = AdamSettings(max_steps=60, learning_rate=0.08, decay=0.5, decay_steps=20)

    @dataclass(frozen=True)
    class Few(BidConfig):
        descent: DescentSettings = DescentSettings(rays=256, level=0, pivot="scene")
        adam: AdamSettings = steps

    monkeypatch.setitem(registered, ("methods", "bid"), replace(METHODS["bid"], config_type=Few))
    start = perturb(blob_images.TRUTH, 0.1, 3.0, seed=2)
    scene = FieldMap(blob_images.FIELD, blob_images.BOUNDS)
    found = Localizer(scene, warm_up=False)(blob_images.FRAME, start)
    assert found.method == "bid"
    assert "the map has no surface" in found.reason
    assert float(pose_error(found.T_world_camera, blob_images.TRUTH).translation) < 0.03


def test_without_bid_a_map_without_a_surface_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    others = [info for info in list_plugins("methods") if info.name != "bid"]
    monkeypatch.setattr("bidnerf_core.registry.list_plugins", lambda group: others)
    localizer = Localizer(FieldMap(blob_images.FIELD, blob_images.BOUNDS), warm_up=False)
    with refused(where="the map has no surface", found="no method 'bid'; installed: auto, inerf"):
        localizer(blob_images.FRAME, blob_images.TRUTH)


def test_the_field_refines_what_the_surface_found() -> None:
    """A soft field's surface lies before what it shows."""
    (view,) = module_fields.shown(1, seed=5)
    scene = FieldMap(module_fields.field(), baked.BOUNDS, module_fields.surface())
    answers = [localize(rig(scene, [view], None), "auto", replace(QUICK, refine_steps=steps)) for steps in (0, 4)]
    before, after = (float(pose_error(found.T_world_camera, view.T_ref_camera).translation) for found in answers)
    assert after < min(0.01, before)
    assert answers[1].converged, answers[1].reason
    assert answers[1].steps > answers[0].steps


@pytest.mark.parametrize(
    "changed",
    [
        lambda view: baked.images(replace(demo_room(), bounds=baked.BOUNDS), 1, seed=0)[0],
        lambda view: replace(view, frame=replace(view.frame, rgb=1 - view.frame.rgb)),
        lambda view: faulty(view, "mirror", 0),
    ],
    ids=["something else", "other colours", "a mirror image"],
)
def test_an_image_of_another_thing_is_rejected(changed: Callable[[View], View]) -> None:
    found = found_for(baked.problem(changed(baked.unseen()[0])))
    assert not found.converged
    assert found.covariance is not None


def test_no_rays_are_rendered_for_an_image_that_disagrees_with_the_surface_everywhere(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    judge = Mock(return_value=answer())
    monkeypatch.setattr(import_module("bidnerf_core.localization.by_surface"), "localization_by_rays", judge)
    view = baked.unseen()[0]
    other = replace(view, frame=replace(view.frame, rgb=1 - view.frame.rgb))
    found = found_for(baked.problem(other).without_depth())
    assert found.outcome is Outcome.RENDERING_MISMATCH
    assert "of the image agree with the surface in a small size, expected 70%" in found.reason
    assert judge.call_count == 0
    assert found_for(baked.problem(view).without_depth()).converged
    assert judge.call_count == 1


def test_a_search_that_ended_early_is_worse_than_a_completed_one_whatever_its_loss(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    module, none = import_module("bidnerf_core.localization.by_surface"), torch.zeros(0, dtype=torch.float64)
    ended = [
        Mock(complete=complete, scores=none.new_full((1,), 30.0), path=SE3.identity()[None], losses=none)
        for complete in (1, 0)
    ]
    completed = answer(outcome=Outcome.UNDETERMINED, loss=50.0)
    monkeypatch.setattr(module, "by_images", Mock(side_effect=[(each, none.new_ones(3)) for each in ended]))
    monkeypatch.setattr(module, "localization_by_rays", Mock(return_value=completed))
    problem = baked.problem(baked.unseen()[0])
    assert module.localize_by_images(problem, baked.toy(), replace(QUICK, rounds=2), 0, None) is completed


def test_what_looks_the_same_from_two_sides_is_ambiguous() -> None:
    """A box that half a turn maps onto itself."""
    scene = baked.even_box()
    surface, (view,) = baked.baked(scene), baked.images(scene, 1, seed=5)
    found = found_for(baked.problem(view, surface=surface))
    assert found.outcome is Outcome.AMBIGUOUS, found.reason


@pytest.mark.parametrize(("recognised", "searched"), [(8, False), (6, True)])
def test_images_are_searched_in_a_map_that_missed_some_of_its_own(
    recognised: int, searched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = Keypoints(torch.zeros((0, 2)), torch.zeros(0), torch.zeros((0, 64), dtype=torch.uint8))
    monkeypatch.setitem(registered, ("features", "points"), lambda rgb: nothing)
    trial = HeldOutTrial(images=8, found=recognised)
    landmarks = replace(point_landmarks(), features="points", trial=trial, usual_matches=20.0)
    search = Mock(return_value=answer())
    monkeypatch.setattr(import_module("bidnerf_core.localization.auto"), "localize_by_images", search)
    problem = replace(baked.problem(baked.unseen()[0]).without_depth(), matcher=LandmarkMatcher(landmarks))
    assert found_for(problem).converged is searched
    assert [call.args[2].rounds for call in search.call_args_list] == [1] * searched
