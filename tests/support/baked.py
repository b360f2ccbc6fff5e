"""What tests of the baked surface and of the search on it share: a toy baked from exact depth, and images of it."""

from __future__ import annotations

import functools
from dataclasses import replace

import torch
from torch import Tensor

from bidnerf.scenes import (
    ClosedFormScene,
    GaussianBlobs,
    Primitive,
    Shape,
    Texture,
    blotches,
    box,
    demo_object,
    orbit,
)
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import SceneBounds, VoxelGrid
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import Problem, Surface, rig
from bidnerf_core.mapping import BakeConfig, SurfaceMap, SurfelIndex, Surfels, bake
from optional import require
from problems import FieldMap

CAMERA = Intrinsics(96.0, 96.0, 36.0, 36.0, 72, 72)
BOUNDS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 12.0, (1.0, 1.0, 1.0))
CONFIG = BakeConfig(cells=100_000)
FIELD = GaussianBlobs.random()  # any field: measured depth does not use it


def baked(scene: ClosedFormScene, count: int = 24) -> SurfaceMap:
    return bake(FIELD, scene.bounds, [], images(scene, count, seed=0), CONFIG)


def images(scene: ClosedFormScene, count: int, seed: int) -> list[View]:
    poses = orbit(3.5, count, elevation=(-10.0, 80.0), seed=seed)
    return [View(scene.render(CAMERA, T, f"{i:04d}", supersample=1), T) for i, T in enumerate(poses)]


@functools.cache
def toy() -> SurfaceMap:
    return baked(demo_object())


@functools.cache
def unseen() -> tuple[View, ...]:
    """Return images of the toy from which its surface was not baked."""
    return tuple(images(demo_object(), 4, seed=7))


def one_solid(shape: Shape, texture: Texture) -> ClosedFormScene:
    return ClosedFormScene([Primitive(shape, SE3.identity(), texture)], BOUNDS, "one")


def even_box() -> ClosedFormScene:
    """Return a box that half a turn maps onto itself."""
    paint, turn = blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1), torch.tensor([-1.0, -1.0, 1.0])

    def both(points: Tensor, normals: Tensor) -> Tensor:
        return (paint(points, normals) + paint(points * turn, normals * turn)) / 2

    return replace(one_solid(box((0.6, 0.4, 0.3)), both), contrast=0.0)


def problem(*views: View, start: SE3 | None = None, surface: SurfaceMap | None = None) -> Problem:
    return rig(FieldMap(FIELD, BOUNDS, toy() if surface is None else surface), views, start)


def points(*views: View, count: int = 1000, seed: int = 0, surface: SurfaceMap | None = None) -> Surface:
    """Return measured points of views whose poses are known in the world, in the last one's frame."""
    return require(Surface.of(problem(*views).views, None, toy() if surface is None else surface, seed, count))


def of_points(positions: Tensor, rgb: Tensor, normal: tuple[float, float, float], cells: int = 20) -> SurfaceMap:
    """Return the surfels of one plane, at most one a cell, in the cube from -1 to 1."""
    grid = VoxelGrid.cube(BOUNDS, cells)
    numbers = grid.numbers(positions)
    assert (numbers.diff() > 0).all(), "one a cell, in the order of the cells"
    count = len(positions)
    surfels = Surfels(positions, positions.new_tensor(normal).expand(count, 3), rgb, positions.new_zeros((count, 3, 3)))
    keyframes = torch.eye(4, dtype=torch.float64)[None]
    return SurfaceMap(surfels, SurfelIndex.of(positions, grid), keyframes)


def patch(half: int = 5, dtype: torch.dtype = torch.float32) -> SurfaceMap:
    """Return a square of 2 ``half`` by 2 ``half`` surfels in the plane z = 0.05, in cells of 0.1."""
    side = (torch.arange(-half, half, dtype=dtype) + 0.5) / 10
    x, y = torch.meshgrid(side, side, indexing="ij")
    positions = torch.stack([x, y, torch.full_like(x, 0.05)], dim=-1).reshape(-1, 3)
    return of_points(positions, (positions + 1) / 2, (0.0, 0.0, 1.0))


def exact(surface: SurfaceMap) -> SurfaceMap:
    """Return the surface in float64, for numerical derivatives."""
    parts = surface.surfels
    values = (parts.positions, parts.normals, parts.rgb, parts.rgb_gradient)
    return replace(surface, surfels=Surfels(*(value.double() for value in values)))
