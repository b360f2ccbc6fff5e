"""Whole methods with the map on a simulated device: they find the poses that they find on the CPU, and return them there."""

from __future__ import annotations

import functools
from dataclasses import replace
from importlib import import_module
from typing import Any

import pytest
import torch

import baked
import module_fields
from bidnerf import SE3, Frame, Localization, Localizer, Tracker
from bidnerf.results import pose_error
from bidnerf.testing import MapWithLandmarks, textured_map, unseen
from bidnerf_core.localization import AutoConfig, settings_of
from flights import INTERVAL, flight_frame, flight_pose
from localizations import without_depth
from module_fields import AsModule
from problems import FieldMap
from simulated_device import DEVICE, Elsewhere

SETTINGS = {
    "points": 400,
    "hypotheses": 48,
    "rounds": 1,
    "refine_steps": 2,
    "refine_rays": 64,
    "fused_rays": 64,
}
BY_COLOUR = {"hypotheses": 8, "rounds": 1, "fine_steps": 2, "fine_rays": 64}


def blobs() -> FieldMap:
    return FieldMap(module_fields.field(), baked.BOUNDS, module_fields.surface())


@functools.cache
def ground() -> MapWithLandmarks:
    found = textured_map(surface=True)
    return replace(found, field=AsModule(found.field))  # type: ignore[arg-type]


def same(here: Localization, there: Localization, tolerance: float = 1e-6) -> None:
    assert there.T_world_camera.device == torch.device("cpu")
    torch.testing.assert_close(there.T_world_camera.matrix(), here.T_world_camera.matrix(), rtol=0, atol=tolerance)
    assert there.outcome is here.outcome
    assert abs(there.steps - here.steps) <= 1  # rounding may end a descent a step earlier
    tensors = (there.losses, there.poses.matrix(), there.covariance)
    assert all(part is None or part.device == torch.device("cpu") for part in tensors)


def on_both(map: Any, frame: Frame, method: str = "auto", start: SE3 | None = None, **settings: Any) -> Localization:
    """Return what a method finds with the map on the CPU, after comparing it with what it finds on the simulated device."""
    config = settings_of(method, settings)
    here = Localizer(map, method, config)(frame, start)
    with Elsewhere():
        same(here, Localizer(map, method, config, device=DEVICE)(frame, start))
    return here


def test_auto_by_depth() -> None:
    (view,) = module_fields.shown(1, seed=5)
    near = view.T_ref_camera.retract(torch.full((6,), 0.02, dtype=torch.float64))
    here = on_both(blobs(), view.frame, start=near, **SETTINGS | {"hypotheses": 8})
    assert here.converged, here.reason
    assert float(pose_error(here.T_world_camera, view.T_ref_camera).translation) < 0.01


def test_auto_by_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is rejected, as a part of the image is in one colour."""
    by_surface = import_module("bidnerf_core.localization.by_surface")
    monkeypatch.setattr(by_surface, "IMAGE_STAGES", ((16, 0, 4, 0.0), (16, 8, 2, 0.0), (48, 6, 2, 0.0)))
    (view,) = module_fields.shown(1, seed=5)
    frame = without_depth(view.frame)
    rgb = frame.rgb.clone()
    rgb[: rgb.shape[0] // 3] = 0.5
    here = on_both(blobs(), replace(frame, rgb=rgb), **BY_COLOUR)
    assert "newly drawn rays" in here.reason


@pytest.mark.parametrize(("depth", "most"), [(False, 56), (True, 55)])
def test_auto_by_landmarks_for_which_the_host_waits_a_handful_of_times(depth: bool, most: int) -> None:
    """It uploads and reads once for the matches, for each round of matching, each measurement and each step on small images."""
    frame, config = unseen().frame if depth else without_depth(unseen().frame), AutoConfig(**SETTINGS)
    here = Localizer(ground(), config=config)(frame)
    assert here.converged, here.reason
    assert ("fused with depth and rendering" if depth else "fused with rendering") in here.reason
    with Elsewhere() as mode:
        localizer = Localizer(ground(), config=config, device=DEVICE)
        same(here, localizer(frame))
        mode.waits.clear()
        localizer(frame)
    assert 0 < sum(mode.waits.values()) <= most, mode.waits


@pytest.mark.parametrize("landmarks", [True, False])
def test_a_tracker_follows_landmarks_and_the_surface(landmarks: bool) -> None:
    """Its pose comes from followed landmarks and depth or, without landmarks, from depth alone."""
    config = AutoConfig(landmarks=landmarks, **SETTINGS)
    start = flight_pose(0)
    here = Tracker(Localizer(ground(), config=config), start=start)
    expected = [here(flight_frame(n), INTERVAL * n) for n in range(3)]
    with Elsewhere():
        there = Tracker(Localizer(ground(), config=config, device=DEVICE), start=start)
        found = [there(flight_frame(n), INTERVAL * n) for n in range(3)]
    assert expected[-1].converged, expected[-1].reason
    for ours, theirs in zip(expected, found, strict=True):
        same(ours, theirs)


def test_a_tracker_follows_depth_without_colours() -> None:
    plain = replace(flight_frame(1), rgb=torch.zeros_like(flight_frame(1).rgb), has_colour=False)
    expected = Tracker(Localizer(ground(), config=AutoConfig(**SETTINGS)), start=flight_pose(0))(plain, 0.0)
    with Elsewhere():
        localizer = Localizer(ground(), config=AutoConfig(**SETTINGS), device=DEVICE)
        same(expected, Tracker(localizer, start=flight_pose(0))(plain, 0.0))
