"""Scenes that repeat themselves: no pose is believed unless something tells the two places apart."""

from __future__ import annotations

import functools
import importlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bidnerf_core import SE3, Frame, Localization, Localizer, Outcome, Tracker
from bidnerf_core.fields import render_image
from bidnerf_core.localization import AutoConfig
from bidnerf_core.results import pose_error
from bidnerf_core.testing import BOUNDS, CAMERA, MapWithLandmarks, ground, textured_map, unseen
from conditions import COPY

with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
    repeated_scene = importlib.import_module("repeated_scene")
twice, DoubledField, copies = (getattr(repeated_scene, name) for name in ("twice", "DoubledField", "copies"))
WIDE = replace(BOUNDS, lower=(-1e3, -1e3, -1e3), upper=(1e3, 1e3, 1e3))
TRUTH = unseen().T_ref_camera
HALFWAY = replace(TRUTH, translation=0.5 * (TRUTH.translation + (COPY @ TRUTH).translation))


@functools.cache
def ground_twice(share: float = 1.0) -> MapWithLandmarks:
    """The landmarks of the ground at two places; its field is at one of them only."""
    landmarks = textured_map().landmarks
    assert landmarks is not None
    return replace(textured_map(), landmarks=twice(landmarks, COPY, share))


def photo(noise: float = 0.0) -> Frame:
    frame = unseen().frame
    off = noise * torch.randn(frame.rgb.shape, generator=torch.Generator().manual_seed(0))
    return replace(frame, rgb=(frame.rgb + off).clamp(0, 1), depth=None)


def near(T: SE3) -> SE3:
    return T.retract(torch.tensor([2.0, 0.0, 0.0, 0.2, 0.0, 0.0], dtype=torch.float64))


def found_in(
    scene: MapWithLandmarks, start: SE3 | None = None, rays: int = 0, frame: Frame | None = None
) -> Localization:
    return Localizer(scene, config=AutoConfig(fused_rays=rays), warm_up=False)(frame or photo(), start)


def assert_right(found: Localization, truth: SE3 = TRUTH) -> None:
    assert found.converged, found.reason
    assert pose_error(found.T_world_camera, truth).translation < 0.02


def test_a_doubled_field_shows_the_same_at_both_places() -> None:
    shown = render_image(ground(), CAMERA, TRUTH, BOUNDS)
    for T_world_copy in copies(BOUNDS)[1:2]:
        field = DoubledField(ground(), BOUNDS, T_world_copy)
        for T in (TRUTH, T_world_copy @ TRUTH):
            there = render_image(field, CAMERA, T, WIDE)
            torch.testing.assert_close(there.rgb, shown.rgb, atol=0.02, rtol=0)
            torch.testing.assert_close(there.depth, shown.depth, atol=1e-3, rtol=1e-3)


@pytest.mark.parametrize("start", [None, HALFWAY], ids=["no start", "between"])
def test_keypoints_alone_leave_it_open(start: SE3 | None) -> None:
    found = found_in(ground_twice(), start)
    assert found.outcome is Outcome.AMBIGUOUS
    assert "the photo fits two places" in found.reason
    assert found.confidence is None


@pytest.mark.parametrize("there", [SE3.identity(), COPY], ids=["here", "copy"])
def test_a_start_decides_also_for_the_place_that_was_not_found_first(there: SE3) -> None:
    """One of two equal places is found first, whichever: the start has to bring each answer to its own."""
    assert_right(found_in(ground_twice(), near(there @ TRUTH)), there @ TRUTH)


@pytest.mark.parametrize("share", [0.15, 0.6])
def test_clearly_more_landmarks_decide_where_nothing_is_rendered(share: float) -> None:
    assert_right(found_in(ground_twice(share)))


def test_renderings_tell_places_apart_that_look_different() -> None:
    assert_right(found_in(ground_twice(), rays=256))


def test_renderings_of_the_same_do_not_tell() -> None:
    same = replace(ground_twice(), field=DoubledField(ground(), BOUNDS, COPY), bounds=WIDE)
    found = found_in(same, rays=1024, frame=photo(noise=0.02))
    assert found.outcome is Outcome.AMBIGUOUS


@pytest.mark.parametrize(("start", "rays"), [(None, 0), (near(TRUTH), 0), (None, 1024)])
def test_a_tracker_begins_only_where_a_start_or_renderings_tell_the_places_apart(
    start: SE3 | None, rays: int
) -> None:
    localizer = Localizer(ground_twice(), config=AutoConfig(fused_rays=rays), warm_up=False)
    found = Tracker(localizer, start=start)(photo(), 0.0)
    if start is None and not rays:
        assert not found.converged
    else:
        assert_right(found)
