"""Measured points are where the scene is, equally from all views."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from bidnerf_core.localization.clouds import measured_cloud

import baked
from bidnerf_core.frames import Frame, View
from bidnerf_core.se3 import SE3


def with_depth(view: View, depth: torch.Tensor | None) -> View:
    return View(replace(view.frame, depth=depth), view.T_ref_camera)


def test_points_lie_on_the_surface_where_the_camera_is() -> None:
    views = baked.unseen()
    cloud = baked.cloud(*views)
    assert len(cloud) == 1000
    world = views[-1].T_ref_camera.apply(cloud.points.double()).float()
    assert baked.toy().distance(world).quantile(0.95) < 2 * baked.toy().cell


def test_views_have_equal_shares_and_their_own_origins() -> None:
    views = baked.unseen()[:2]
    cloud = baked.cloud(*views, count=400)
    own = (cloud.origins == 0).all(-1)
    assert own.sum() == 200
    other = (views[1].T_ref_camera.inverse() @ views[0].T_ref_camera).translation.float()
    assert torch.allclose(cloud.origins[~own], other.expand(200, 3), atol=1e-5)
    assert 0 < own[:50].sum() < 50  # the first few are of all views


def test_only_what_was_measured_is_a_point() -> None:
    frame = Frame("f", torch.rand(2, 3, 3), replace(baked.CAMERA, width=3, height=2))
    depth = torch.tensor([[0.0, 2.0, torch.nan], [-1.0, torch.inf, 3.0]])
    problem = baked.problem(View(replace(frame, depth=depth), SE3.identity()))
    cloud = measured_cloud(problem, 100, torch.Generator().manual_seed(0))
    assert sorted(cloud.points[:, 2].tolist()) == pytest.approx([2.0, 3.0], rel=1e-6)
    colours = {tuple(row) for row in cloud.rgb.tolist()}
    assert colours == {tuple(frame.rgb[0, 1].tolist()), tuple(frame.rgb[1, 2].tolist())}


def test_without_depth_there_are_no_points() -> None:
    view = baked.unseen()[0]
    assert len(baked.cloud(with_depth(view, None))) == 0
    assert len(baked.cloud(with_depth(view, torch.zeros_like(view.frame.rgb[..., 0])))) == 0
    assert len(baked.cloud(with_depth(view, None), view, count=100)) == 50
