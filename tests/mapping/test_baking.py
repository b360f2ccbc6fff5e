"""The baked surface is where the scene is; what only one view sees is not on it; and how large its cells are.

Their size follows the resolution of the images, their noise, the number of points and the memory.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from importlib import import_module

import pytest
import torch
from torch import Generator, Tensor

import baked
from balls import HomogeneousBall
from bidnerf.scenes import ball, blotches, box, orbit
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.fields import FieldValues, SceneBounds, VoxelGrid
from bidnerf_core.frames import View
from bidnerf_core.mapping import BakeConfig, SurfaceMap, bake

# Inside: the size of cells and the noise of depth are compared with those of the scene
from bidnerf_core.mapping.surface.posed_depth import (
    PosedDepthImage,
    choose_grid,
    depth_noise,
    footprint,
    posed_measurement,
    surface_bytes,
)
from bidnerf_core.progress import job_context
from optional import require

RADIUS = 0.6
BALL = baked.one_solid(ball(RADIUS), blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1))


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
        world = view.T_ref_camera.apply(baked.points(view, count=500).points).float()
        assert (surface.distance(world) < 2 * surface.cell).float().mean() > 0.95


def test_colours_are_those_of_the_scene() -> None:
    blue = torch.tensor([0.2, 0.4, 0.8])
    scene = baked.one_solid(box((0.5, 0.5, 0.5)), lambda points, normals: blue.expand(len(points), 3))
    surface = measured(baked.images(replace(scene, contrast=0.0), 8, seed=0))
    assert torch.allclose(surface.surfels.rgb, blue, atol=1e-5)


def test_a_floater_that_one_view_sees_is_dropped() -> None:
    views = ball_views()
    frame = views[3].frame
    depth = require(frame.depth).clone()
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
    with job_context(lambda progress: told.append((progress.done, progress.total))):
        surface = bake(
            HomogeneousBall(RADIUS, 300.0),
            baked.BOUNDS,
            [(baked.CAMERA, T) for T in poses],
            config=BakeConfig(rays=20_000, cells=30_000),
        )
    assert told == [(i, 10) for i in range(1, 11)]
    assert height(surface).abs().max() < 1
    assert torch.equal(surface.keyframes, torch.stack([T.matrix() for T in poses]))
    assert surface.index.entries.device.type == "cpu"


def test_the_grid_has_at_most_the_given_number_of_cells() -> None:
    for bounds in (baked.BOUNDS, replace(baked.BOUNDS, lower=(-1.0, -0.9, 0.599), upper=(1.0, 1.0, 0.601))):
        surface = bake(baked.FIELD, bounds, [], ball_views(), replace(baked.CONFIG, cells=5000))
        assert math.prod(surface.grid.shape) <= 5000
        for size, side in zip(surface.grid.shape, bounds.size, strict=True):
            assert size * surface.cell >= side


def test_where_nothing_was_seen_there_is_no_surface() -> None:
    with pytest.raises(InputError, match="no surface to bake"):
        measured([replace(view, frame=view.frame.replace(depth=torch.zeros(72, 72))) for view in ball_views(3)])
    empty = HomogeneousBall(RADIUS, 1e-3)
    with pytest.raises(InputError, match="no surface to bake"):
        bake(empty, baked.BOUNDS, [(baked.CAMERA, T) for T in orbit(3.5, 3)], config=BakeConfig(rays=2000))
    with pytest.raises(InputError, match="at least one camera or view"):
        bake(baked.FIELD, baked.BOUNDS, [])


def test_views_that_contradict_each_other_have_no_surface() -> None:
    views = ball_views(4)
    spoilt = [
        View(replace(view.frame, depth=require(view.frame.depth) * (0.8 + 0.1 * i)), view.T_ref_camera)
        for i, view in enumerate(views)
    ]
    with pytest.raises(InputError, match="several views agree on"):
        measured(spoilt, agreement=3, cells=4_000_000)


SCENE = baked.one_solid(box((0.6, 0.6, 0.6)), blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1))


def images(noise: float, generator: Generator, count: int = 16) -> list[PosedDepthImage]:
    found = []
    for view in baked.images(SCENE, count, seed=0):
        depth = require(view.frame.depth)
        noisy = torch.where(depth > 0, depth + noise * torch.randn(depth.shape, generator=generator), 0)
        found.append(posed_measurement(View(replace(view.frame, depth=noisy), view.T_ref_camera), 1e9))
    return found


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_the_noise_of_depth_is_measured(noise: float, generator: Generator) -> None:
    # Interpolation between four pixels averages the noise of one of the two that are compared.
    assert 0.6 * noise < depth_noise(images(noise, generator), 0.9) < 1.2 * noise


def test_exact_depth_has_little_noise(generator: Generator) -> None:
    assert depth_noise(images(0.0, generator), 0.9) < 0.1 * footprint(images(0.0, generator), 0.9)


def test_a_single_image_has_no_noise(generator: Generator) -> None:
    assert depth_noise(images(0.02, generator, 1), 0.9) == 0.0
    assert depth_noise([], 0.9) == 0.0


def test_the_footprint_is_that_of_the_full_image_and_the_spacing_that_of_the_thinned_one() -> None:
    view = baked.images(SCENE, 1, seed=0)[0]
    thinned = [posed_measurement(view, view.frame.intrinsics.width * view.frame.intrinsics.height / 9)]
    depth = require(view.frame.depth)
    distance = float(depth[depth > 0].median())
    assert footprint(thinned, 0.9) == pytest.approx(distance / baked.CAMERA.fx, rel=0.02)
    assert footprint(thinned, 0.9, subsampled=True) == pytest.approx(3 * distance / baked.CAMERA.fx, rel=0.05)


def scattered(count: int, generator: Generator) -> Tensor:
    """Return points (metres) in the plane z = 0.03 of the box."""
    flat = 2 * torch.rand((count, 2), generator=generator) - 1
    return torch.cat([flat, torch.full((count, 1), 0.03)], dim=1)


def test_few_points_make_cells_coarser_but_no_coarser_than_their_spacing(generator: Generator) -> None:
    many, few = scattered(100_000, generator), scattered(1000, generator)
    assert choose_grid(many, baked.BOUNDS, 0.02, 0.2, 200.0).cell == 0.02
    grid = choose_grid(few, baked.BOUNDS, 0.02, 0.2, 200.0)
    assert 0.02 < grid.cell < 0.2
    assert len(few) >= 1.32 * len(grid.numbers(few).unique())
    assert choose_grid(few[:1], baked.BOUNDS, 0.02, 0.1, 200.0).cell == 0.1


def test_memory_is_bounded_and_a_warning_says_so(generator: Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    points = scattered(20_000, generator)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        free = choose_grid(points, baked.BOUNDS, 0.03, 0.03, 200.0)
    with pytest.warns(InputWarning, match=r"MB with cells of 0\.03; cells of .* within 0\.2 MB.*`megabytes`"):
        bounded = choose_grid(points, baked.BOUNDS, 0.03, 0.03, 0.2)
    assert surface_bytes(points, bounded) <= 0.2e6 < surface_bytes(points, free)
    assert bounded.cell < 0.18  # no coarser than needed
    with pytest.raises(InputError, match="allow more megabytes"):
        choose_grid(points, baked.BOUNDS, 0.03, 0.03, 1e-5)
    posed_depth = import_module("bidnerf_core.mapping.surface.posed_depth")
    assert posed_depth.MOST_CELLS <= 2**31
    monkeypatch.setattr(posed_depth, "MOST_CELLS", 2**22)
    with pytest.warns(InputWarning, match="too many cells"):
        assert math.prod(choose_grid(points, baked.BOUNDS, 0.01, 0.01, 200.0).shape) <= 2**22


def test_a_room_in_a_box_of_a_hundred_times_its_volume_takes_little_more_memory() -> None:
    """Points are 4 cm apart on the floor, the ceiling and the walls."""
    size, faces, taken = (6.0, 4.0, 3.0), list[Tensor](), dict[float, int]()
    sides = [torch.arange(0.02, length, 0.04) for length in size]
    for axis, length in enumerate(size):
        for at in (0.01, length - 0.01):
            face = [torch.tensor([at]) if i == axis else side for i, side in enumerate(sides)]
            faces += [torch.cartesian_prod(*face)]
    points = torch.cat(faces)
    for times in (1.0, 100 ** (1 / 3)):
        box = SceneBounds((0.0, 0.0, 0.0), (6.0 * times, 4.0 * times, 3.0 * times), 0.0, 100.0)
        taken[times] = surface_bytes(points, VoxelGrid.covering(box, 0.05))
    small, large = taken.values()
    assert small < large < 2 * small


def test_a_baked_surface_stays_within_its_memory() -> None:
    with pytest.warns(InputWarning, match="0\\.2 MB"):
        surface = bake(baked.FIELD, baked.BOUNDS, [], baked.images(SCENE, 12, seed=0), BakeConfig(megabytes=0.2))
    assert surface.mebibytes < 0.25e6 / 2**20  # surfels move a little when planes are fitted
    assert (surface.surfels.positions.abs().amax(-1) < 0.6 + surface.cell).all()
