"""The baked surface is where the scene is; what only one view sees is not on it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

import baked
from bidnerf_core.errors import InputError
from bidnerf_core.fields import FieldValues
from bidnerf_core.frames import View
from bidnerf_core.mapping import BakeConfig, SurfaceMap, bake
from bidnerf_core.scenes import Box, HomogeneousBall, Sphere, blotches, orbit

RADIUS = 0.6
BALL = baked.one_solid(Sphere(RADIUS), blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1))


def ball_views(count: int = 12) -> list[View]:
    return baked.images(BALL, count, seed=0)


def height(surface: SurfaceMap) -> Tensor:
    """Return the heights of surfels above the ball, in cells."""
    return (torch.linalg.vector_norm(surface.surfels.positions, dim=-1) - RADIUS) / surface.cell


def measured(views: list[View], **changes: object) -> SurfaceMap:
    return bake(baked.FIELD, baked.BOUNDS, [], views, replace(baked.CONFIG, **changes))  # type: ignore[arg-type]


def test_surfels_lie_on_the_true_surface() -> None:
    surface = measured(ball_views())
    assert len(surface.surfels) > 500
    assert height(surface).abs().max() < 1
    outward = torch.nn.functional.normalize(surface.surfels.positions, dim=-1)
    assert ((outward * surface.surfels.normals).sum(-1).abs() > 0.9).float().mean() > 0.95


def test_all_that_was_seen_is_there() -> None:
    surface = baked.toy()
    for view in baked.unseen():
        cloud = baked.cloud(view, count=500)
        world = view.T_ref_camera.apply(cloud.points.double()).float()
        assert (surface.distance(world) < 2 * surface.cell).float().mean() > 0.95


def test_colours_are_those_of_the_scene() -> None:
    blue = torch.tensor([0.2, 0.4, 0.8])
    scene = baked.one_solid(Box((0.5, 0.5, 0.5)), lambda points, normals: blue.expand(len(points), 3))
    flat = replace(scene, contrast=0.0)
    surface = measured(baked.images(flat, 8, seed=0))
    assert torch.allclose(surface.surfels.rgb, blue, atol=1e-5)


def test_a_floater_that_one_view_sees_is_dropped() -> None:
    views = ball_views()
    frame = views[3].frame
    assert frame.depth is not None
    depth = frame.depth.clone()
    depth[30:40, 30:40] = 2.0  # well before the ball
    views[3] = View(replace(frame, depth=depth), views[3].T_ref_camera)
    assert height(measured(views)).abs().max() < 1
    assert height(measured(views, agreement=0)).max() < 1  # those that see through it outvote it


def test_a_single_view_is_believed() -> None:
    assert height(measured(ball_views()[:1])).abs().max() < 1


class Mute(HomogeneousBall):
    def query(self, positions: Tensor, directions: Tensor) -> FieldValues:
        raise AssertionError("asked")


def test_measured_views_are_taken_as_they_are() -> None:
    bake(Mute(RADIUS, 300.0), baked.BOUNDS, [], ball_views(), baked.CONFIG)


def test_a_field_shows_its_surface() -> None:
    poses, told = orbit(3.5, 10, seed=0), []
    surface = bake(
        HomogeneousBall(RADIUS, 300.0),
        baked.BOUNDS,
        [(baked.CAMERA, T) for T in poses],
        config=BakeConfig(rays=20_000, cells=30_000),
        progress=lambda done, total: told.append((done, total)),
    )
    assert told == [(i, 10) for i in range(1, 11)]
    assert height(surface).abs().max() < 1
    assert torch.equal(surface.keyframes, torch.stack([T.matrix() for T in poses]))
    assert surface.index.entries.device.type == "cpu"


def test_the_grid_has_no_more_cells_than_were_asked_for() -> None:
    for bounds in (baked.BOUNDS, replace(baked.BOUNDS, lower=(-1.0, -0.9, 0.599), upper=(1.0, 1.0, 0.601))):
        surface = bake(baked.FIELD, bounds, [], ball_views(), replace(baked.CONFIG, cells=5000))
        assert math.prod(surface.grid.shape) <= 5000
        for size, side in zip(surface.grid.shape, bounds.size, strict=True):
            assert size * surface.cell >= side


def bare(view: View) -> View:
    assert view.frame.depth is not None
    return View(replace(view.frame, depth=torch.zeros_like(view.frame.depth)), view.T_ref_camera)


def test_where_nothing_was_seen_there_is_no_surface() -> None:
    with pytest.raises(InputError, match="no surface to bake"):
        measured([bare(view) for view in ball_views(3)])
    empty = HomogeneousBall(RADIUS, 1e-3)
    with pytest.raises(InputError, match="no surface to bake"):
        bake(empty, baked.BOUNDS, [(baked.CAMERA, T) for T in orbit(3.5, 3)], config=BakeConfig(rays=2000))
    with pytest.raises(InputError, match="at least one camera or view"):
        bake(baked.FIELD, baked.BOUNDS, [])


def test_views_that_contradict_each_other_have_no_surface() -> None:
    views = ball_views(4)
    spoilt = []
    for i, view in enumerate(views):
        assert view.frame.depth is not None
        spoilt.append(View(replace(view.frame, depth=view.frame.depth * (0.8 + 0.1 * i)), view.T_ref_camera))
    with pytest.raises(InputError, match="several views agree on"):
        measured(spoilt, agreement=3, cells=4_000_000)


@pytest.mark.parametrize(
    "wrong",
    [
        {"rays": 0},
        {"measured": 0},
        {"cells": 10},
        {"megabytes": 0.0},
        {"opacity": 1.0},
        {"opacity": float("nan")},
        {"agreement": 9},
    ],
)
def test_settings_are_judged(wrong: dict[str, float]) -> None:
    (name,) = wrong
    with pytest.raises(InputError, match=f"{name} is"):
        BakeConfig(**wrong)  # type: ignore[arg-type]
