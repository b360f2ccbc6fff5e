"""Whole methods with the map on a pretended device: they find the poses that they find on the CPU, and return them there."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Generator, Tensor

import baked
import module_fields
import textured_field
from bidnerf_core import Frame, Localization, Localizer, Tracker
from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.frames import View
from bidnerf_core.localization import AutoConfig, settings_of
from bidnerf_core.localization.search import matching
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.testing.elsewhere import DEVICE, Elsewhere
from module_fields import AsModule
from problems import FieldMap
from textured_field import MapWithLandmarks

SETTINGS = {"points": 400, "hypotheses": 48, "rounds": 1, "refine_steps": 2, "refine_rays": 64, "fused_rays": 64}
BY_COLOUR = {"hypotheses": 16, "rounds": 1, "coarse_steps": 1, "coarse_rays": 32, "fine_steps": 2, "fine_rays": 64}


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


def on_both(map: Any, frame: Frame, method: str = "auto", **settings: Any) -> tuple[Localization, Localization]:
    """Return what a method finds with the map on the CPU, and with the map on the pretended device."""
    config, start = settings_of(method, settings), None
    here = Localizer(map, method, config)(frame, start)
    with Elsewhere():
        there = Localizer(map, method, config, device=DEVICE)(frame, start)
    same(here, there)
    return here, there


def test_auto_by_depth() -> None:
    (view,) = module_fields.shown(1, seed=5)
    here, _ = on_both(blobs(), view.frame, **SETTINGS)
    assert here.converged, here.reason
    assert float(pose_error(here.T_world_camera, view.T_ref_camera).translation) < 0.01


def test_auto_by_colour() -> None:
    (view,) = module_fields.shown(1, seed=5)
    here, _ = on_both(blobs(), without_depth(view), **BY_COLOUR)
    assert "fresh rays" in here.reason


@pytest.mark.parametrize("depth", [True, False])
def test_auto_by_landmarks(depth: bool) -> None:
    view = textured_field.unseen()
    here, _ = on_both(ground(), view.frame if depth else without_depth(view), **SETTINGS)
    assert here.converged, here.reason
    assert ("fused with depth and rendering" if depth else "fused with rendering") in here.reason
