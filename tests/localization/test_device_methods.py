"""Whole methods with the map on a simulated device: they find the poses that they find on the CPU, and return them there."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import baked
import module_fields
from bidnerf_core import SE3, Frame, Localization, Localizer, Tracker
from bidnerf_core.evaluation import perturb
from bidnerf_core.frames import View
from bidnerf_core.localization import (
    AutoConfig,
    LandmarkMatcher,
    by_image_search,
    on_device,
    rig,
    settings_of,
)
from bidnerf_core.localization.landmarks import matching
from bidnerf_core.localization.search.by_images import ImageSearch, ImageStage
from bidnerf_core.results import pose_error
from bidnerf_core.testing import DEVICE, Elsewhere, MapWithLandmarks, textured_field
from flights import INTERVAL, flight_frame, flight_pose
from module_fields import AsModule
from problems import FieldMap

SETTINGS = {
    "points": 400,
    "hypotheses": 48,
    "rounds": 1,
    "refine_steps": 2,
    "refine_rays": 64,
    "fused_rays": 64,
}
BY_COLOUR = {
    "hypotheses": 16,
    "rounds": 1,
    "coarse_steps": 1,
    "coarse_rays": 32,
    "fine_steps": 2,
    "fine_rays": 64,
}


def blobs() -> FieldMap:
    return FieldMap(module_fields.field(), baked.BOUNDS, module_fields.surface())


@functools.cache
def ground() -> MapWithLandmarks:
    found = textured_field.textured_map(surface=True)
    return replace(found, field=AsModule(found.field))  # type: ignore[arg-type]


def without_depth(view: View) -> Frame:
    return replace(view.frame, depth=None)


def same(here: Localization, there: Localization, tolerance: float = 1e-6) -> None:
    assert there.T_world_camera.device == torch.device("cpu")
    torch.testing.assert_close(
        there.T_world_camera.matrix(), here.T_world_camera.matrix(), rtol=0, atol=tolerance
    )
    assert (there.outcome, there.steps) == (here.outcome, here.steps)
    tensors = (there.losses, there.poses.matrix(), there.covariance)
    assert all(part is None or part.device == torch.device("cpu") for part in tensors)


def on_both(
    map: Any, frame: Frame, method: str = "auto", start: SE3 | None = None, **settings: Any
) -> Localization:
    """Return what a method finds with the map on the CPU, after comparing it with what it finds on the simulated device."""
    config = settings_of(method, settings)
    here = Localizer(map, method, config)(frame, start)
    with Elsewhere():
        same(here, Localizer(map, method, config, device=DEVICE)(frame, start))
    return here


def test_auto_by_depth() -> None:
    (view,) = module_fields.shown(1, seed=5)
    here = on_both(blobs(), view.frame, **SETTINGS)
    assert here.converged, here.reason
    assert float(pose_error(here.T_world_camera, view.T_ref_camera).translation) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("rounds", [1, 2])
def test_auto_by_colour(monkeypatch: pytest.MonkeyPatch, rounds: int) -> None:
    """The second round follows if the first is not accepted, which a part of the image in one colour prevents."""
    (view,) = module_fields.shown(1, seed=5)
    frame = without_depth(view)
    rgb = frame.rgb.clone()
    rgb[: rgb.shape[0] // 3] = 0.5
    few = (ImageStage(16, 0, 8), ImageStage(16, 3, 2), ImageStage(24, 2, 1))
    monkeypatch.setattr(by_image_search, "IMAGE_STAGES", few)
    monkeypatch.setattr(by_image_search, "DETAILED_STAGES", few)
    here = on_both(blobs(), replace(frame, rgb=rgb), **BY_COLOUR | {"rounds": rounds})
    assert "newly drawn rays" in here.reason


@pytest.mark.parametrize("depth", [True, False])
def test_auto_by_landmarks(depth: bool) -> None:
    view = textured_field.unseen()
    here = on_both(ground(), view.frame if depth else without_depth(view), **SETTINGS)
    assert here.converged, here.reason
    assert ("fused with depth and rendering" if depth else "fused with rendering") in here.reason


def test_images_that_the_field_renders_are_compared_there() -> None:
    (view,) = module_fields.shown(1, seed=5)
    problem = rig(blobs(), [view], perturb(view.T_ref_camera, 0.1, 3, 0))
    poses = SE3.stack([perturb(problem.start_for(""), 0.1, 3, seed) for seed in range(4)])
    stages = (ImageStage(16, 2, 2), ImageStage(24, 2, 1))
    here = ImageSearch.in_field(problem, poses[0])(poses, stages)
    with Elsewhere():
        moved_problem = rig(on_device(blobs(), DEVICE), [view], problem.start)
        there = ImageSearch.in_field(moved_problem, poses[0])(poses, stages)
    assert there.T.device == torch.device("cpu")
    torch.testing.assert_close(there.T.matrix(), here.T.matrix(), rtol=0, atol=1e-5)
    torch.testing.assert_close(there.losses, here.losses)


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


@pytest.mark.parametrize("exhaustive", [True, False])
def test_descriptors_are_compared_there_and_answers_returned(
    exhaustive: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matching, "EXHAUSTIVE", 10**9 if exhaustive else 50)
    monkeypatch.setattr(matching, "COMPARISONS", 10**9 if exhaustive else 0)
    landmarks = ground().landmarks
    assert landmarks is not None
    queries = landmarks.descriptors[::3]
    expected = LandmarkMatcher(landmarks).nearest(queries, 2)
    compared: list[torch.device] = []
    distances = matching.squared_distances

    def noted(a: Tensor, b: Tensor) -> Tensor:
        compared.extend([a.device, b.device])
        return distances(a, b)

    monkeypatch.setattr(matching, "squared_distances", noted)
    with Elsewhere():
        matcher = LandmarkMatcher(landmarks.to(DEVICE))
        found = matcher.nearest(queries, 2)
        assert matcher.landmarks.positions.device == torch.device("cpu")
    assert set(compared) == {DEVICE}
    for ours, theirs in zip(found, expected, strict=True):
        assert torch.equal(ours, theirs)
