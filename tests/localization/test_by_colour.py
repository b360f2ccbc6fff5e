"""Poses by colour alone, as ``auto`` finds them without depth: a closed-form field, its baked surface, and plain images."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
import torch

import baked
from bidnerf_core.evaluation import faulty
from bidnerf_core.fields import render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import AutoConfig, Localization, Problem, rig
from bidnerf_core.mapping import SurfaceMap, bake
from bidnerf_core.results import pose_error
from bidnerf_core.scenes import GaussianBlobs, orbit
from localizations import answer, assert_covered, assert_near, colour_only
from problems import FieldMap, localize
from refusals import refused

BOUNDS = replace(baked.BOUNDS, lower=(-1.2, -1.2, -1.2), upper=(1.2, 1.2, 1.2))
FIELD = GaussianBlobs.random(samples=32, density=60.0)
QUICK = AutoConfig(hypotheses=48, rounds=1)
SEEN = orbit(3.5, 24, elevation=(-10.0, 80.0), seed=0)
UNSEEN = orbit(3.5, 3, elevation=(-10.0, 80.0), seed=7)


@functools.cache
def surface() -> SurfaceMap:
    return bake(FIELD, BOUNDS, [(baked.CAMERA, T) for T in SEEN], config=baked.CONFIG)


@functools.cache
def photograph(T: SE3, depth: bool = False) -> View:
    seen = render_image(FIELD, baked.CAMERA, T, BOUNDS)
    return View(Frame("frame", seen.rgb, baked.CAMERA, seen.depth if depth else None), T)


def problem(*views: View, start: SE3 | None = None) -> Problem:
    return rig(FieldMap(FIELD, BOUNDS, surface()), views, start)


def assert_right(found: Localization, truth: SE3) -> None:
    assert_near(found.T_world_camera, truth, 0.03, 0.5)
    assert found.converged, found.reason


@pytest.mark.slow
def test_no_start_is_needed() -> None:
    truth = UNSEEN[1]
    found = localize(problem(photograph(truth)), "auto", QUICK)
    assert_right(found, truth)
    assert found.method == "auto"
    assert found.steps == len(found.losses) == len(found.poses.translation) - 1
    assert_covered(found.T_world_camera, truth, found.covariance)


@pytest.mark.slow
def test_the_second_round_leaves_out_what_hides_the_scene() -> None:
    """Nothing suggests that the pose is right, however, where a third of the image cannot be explained."""
    truth = UNSEEN[0]
    hidden = faulty(photograph(truth), "occluder:0.3", seed=1)
    found = [localize(problem(hidden), "auto", replace(QUICK, rounds=rounds)) for rounds in (1, 2)]
    off = [float(pose_error(each.T_world_camera, truth).translation) for each in found]
    assert off[0] > 0.3
    assert off[1] < 0.03
    assert all(each.outcome is Outcome.RENDERING_MISMATCH for each in found)


def test_measured_depth_that_is_too_little_does_no_harm() -> None:
    view = photograph(UNSEEN[2], depth=True)
    assert view.frame.depth is not None
    depth = torch.zeros_like(view.frame.depth)
    depth[30:33, 30:40] = view.frame.depth[30:33, 30:40]
    few = View(replace(view.frame, depth=depth), view.T_ref_camera)
    assert_right(localize(problem(few), "auto", QUICK, 3), UNSEEN[2])


def test_a_start_is_one_more_place_to_look() -> None:
    truth = UNSEEN[0]
    aside = replace(surface(), keyframes=surface().keyframes[:1])
    turned = truth @ SE3.exp(torch.tensor([0.07, 0.0, 0.07, 0.07, 0.2, 0.07], dtype=torch.float64))
    started = rig(FieldMap(FIELD, BOUNDS, aside), [photograph(truth)], turned)
    found = localize(started, "auto", replace(QUICK, hypotheses=96))
    assert_right(found, truth)
    assert torch.equal(found.poses[0].matrix(), turned.matrix())


def test_an_image_of_something_else_is_rejected() -> None:
    view = baked.unseen()[0]
    found = localize(problem(colour_only(view)), "auto", QUICK)
    assert not found.converged
    assert "expected" in found.reason


def test_a_map_without_surface_needs_a_start() -> None:
    with refused(where="the map has no surface", found="method 'auto' then needs a start"):
        localize(rig(FieldMap(FIELD, BOUNDS), [photograph(UNSEEN[0])], None), "auto", QUICK)


def accepted() -> Localization:
    return answer(covariance=0.05**2 * torch.eye(6, dtype=torch.float64))
