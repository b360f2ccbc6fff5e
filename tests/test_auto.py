"""Method ``auto``: poses without a start, with one, and what it does where there is no surface or no depth."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from bidnerf_core.localization.clouds import measured_cloud

import baked
import bidnerf_core.localization.auto as module
from bidnerf_core.errors import InputError
from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.evaluation.protocols import perturb
from bidnerf_core.frames import Frame, View
from bidnerf_core.localization import AutoConfig, Localization, Problem, localize, rig
from bidnerf_core.localization.bid import BidConfig
from bidnerf_core.localization.search import Found, score
from bidnerf_core.mapping import bake
from bidnerf_core.rendering import render_image
from bidnerf_core.scenes.demo import demo_room
from bidnerf_core.scenes.fields import GaussianBlobs
from bidnerf_core.scenes.trajectories import orbit
from bidnerf_core.se3 import SE3

QUICK = AutoConfig(points=1000, hypotheses=128, refine_steps=0)
"""The field of these tests does not show the toy."""


def found_for(problem: Problem, seed: int = 0) -> Localization:
    return localize(problem, "auto", QUICK, seed)


def assert_right(found: Localization, truth: SE3) -> None:
    error = pose_error(found.T_world_camera, truth)
    assert float(error.translation) < 0.05
    assert float(error.rotation_deg) < 1


@pytest.mark.parametrize("number", range(4))
def test_no_start_is_needed(number: int) -> None:
    view = baked.unseen()[number]
    found = found_for(baked.problem(view))
    assert_right(found, view.T_ref_camera)
    assert found.converged, found.reason
    assert found.method == "auto"
    assert found.T_world_camera.rotation.dtype == torch.float64
    assert found.steps == len(found.losses) == len(found.poses.translation) - 1
    assert found.losses[-1] < found.losses[0]
    assert found.covariance is not None
    xi = (found.T_world_camera.inverse() @ view.T_ref_camera).log()
    assert xi @ torch.linalg.solve(found.covariance, xi) < 16.8  # 99 % of chi^2 with 6 degrees of freedom


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


def test_a_rig_is_placed_by_its_last_camera() -> None:
    views = baked.unseen()
    found = found_for(baked.problem(*views))
    assert_right(found, views[-1].T_ref_camera)
    assert found.converged, found.reason


def test_the_same_seed_gives_the_same_answer() -> None:
    problem = baked.problem(baked.unseen()[1])
    first = found_for(problem, 3)
    torch.manual_seed(99)
    again = found_for(problem, 3)
    assert torch.equal(first.T_world_camera.matrix(), again.T_world_camera.matrix())
    assert torch.equal(first.losses, again.losses)
    assert not torch.equal(first.T_world_camera.matrix(), found_for(problem, 4).T_world_camera.matrix())


def shown(field: GaussianBlobs, count: int, seed: int) -> list[View]:
    """Images of what a field shows, with its depth."""
    views = []
    for place, T in enumerate(orbit(3.5, count, elevation=(-10.0, 60.0), seed=seed)):
        image = render_image(field, baked.CAMERA, T, baked.BOUNDS)
        depth = torch.where(image.opacity > 0.95, image.depth, 0)
        views.append(View(Frame(f"{place:04d}", image.rgb, baked.CAMERA, depth), T))
    return views


def test_the_field_refines_what_the_surface_found() -> None:
    field = GaussianBlobs.random(density=60.0)
    surface = bake(field, baked.BOUNDS, [], shown(field, 12, seed=0), baked.CONFIG)
    view = shown(field, 1, seed=5)[0]
    problem = rig(field, baked.BOUNDS, [view], None, surface=surface)
    generator = torch.Generator().manual_seed(0)
    cloud = measured_cloud(problem, 500, generator)
    near = perturb(view.T_ref_camera, 0.08, 3, 0)
    found = Found(near, float(score(surface, cloud, near[None])[0]), math.inf, near[None])
    refined, share = module._refined(problem, surface, cloud, found, AutoConfig(refine_steps=4), generator)
    error = pose_error(refined.T, view.T_ref_camera)
    assert float(error.translation) < 0.02
    assert float(error.rotation_deg) < 0.5
    assert torch.equal(refined.path[0].matrix(), near.matrix())
    assert len(refined.path.translation) > 1
    assert share > 0.9


def test_a_field_that_does_not_show_the_surface_has_no_say() -> None:
    problem = baked.problem(baked.unseen()[0])
    found = localize(problem, "auto", replace(QUICK, refine_steps=3), 0)
    assert torch.equal(found.T_world_camera.matrix(), found_for(problem).T_world_camera.matrix())
    assert not found.converged
    assert "rays that the field renders" in found.reason


def test_an_image_of_something_else_is_not_found() -> None:
    room = baked.images(replace(demo_room(), bounds=baked.BOUNDS), 1, seed=0)[0]
    found = found_for(baked.problem(room))
    assert not found.converged
    assert found.covariance is not None


def test_nothing_is_asked_of_the_gradient_and_nothing_is_left_behind() -> None:
    with torch.enable_grad():
        found = found_for(baked.problem(baked.unseen()[0]))
    assert not found.T_world_camera.rotation.requires_grad
    assert torch.is_grad_enabled()


def colour_only(view: View) -> View:
    return View(replace(view.frame, depth=None), view.T_ref_camera)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda v, T: rig(baked.FIELD, baked.BOUNDS, [v], T), "the map has no surface"),
        (lambda v, T: rig(baked.FIELD, baked.BOUNDS, [colour_only(v)], T), "the map has no surface"),
    ],
    ids=["depth", "no depth"],
)
def test_without_surface_a_start_is_needed(make, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    view = baked.unseen()[0]
    with pytest.raises(InputError, match=said) as told:
        found_for(make(view, None))
    assert "needs a start" in str(told.value)
    assert "\n" not in str(told.value)
    monkeypatch.setattr(module, "BidConfig", lambda: BidConfig(max_steps=2, rays=32))
    found = found_for(make(view, view.T_ref_camera))
    assert (found.method, found.steps) == ("bid", 2)
    assert said in found.reason


@pytest.mark.parametrize("wrong", [{"points": 10}, {"hypotheses": 0}, {"rounds": 0}, {"rounds": 1000}])
def test_settings_are_judged(wrong: dict[str, int]) -> None:
    (name,) = wrong
    with pytest.raises(InputError, match=f"{name} is"):
        AutoConfig(**wrong)
