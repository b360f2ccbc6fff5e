"""The cost of poses on a surface: exact gradients, zero at the truth, the same in a moved world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from bidnerf_core.localization.alignment import Cloud, Scales, alignment, contact, misfit
from torch import Generator, Tensor

import baked
from bidnerf_core.mapping import SurfaceMap, Surfels
from bidnerf_core.se3 import SE3
from bidnerf_core.voxel_grid import VoxelGrid

SCALES = Scales(0.1, 0.3, 0.7)


def poses(generator: Generator, count: int = 4, size: float = 0.05) -> SE3:
    """About the first of the unseen images' own."""
    near = size * torch.randn((count, 6), generator=generator, dtype=torch.float64)
    return baked.unseen()[0].T_ref_camera.retract(near)


def exact_cloud(count: int = 150) -> Cloud:
    seen = baked.cloud(baked.unseen()[0], count=count)
    return Cloud(seen.points.double(), seen.rgb.double(), seen.origins.double())


def numerical(cost: Callable[[Tensor], Tensor], eps: float = 1e-6) -> Tensor:
    """Central differences of a scalar by a tangent at 0."""
    steps = eps * torch.eye(6, dtype=torch.float64)
    return torch.stack([(cost(d) - cost(-d)) / (2 * eps) for d in steps])


@pytest.mark.parametrize("colour_weight", [0.0, 0.7], ids=["distance", "colour"])
def test_the_gradient_is_that_of_the_cost(colour_weight: float, generator: Generator) -> None:
    surface, cloud = baked.exact(baked.toy()), exact_cloud()
    scales = replace(SCALES, colour_weight=colour_weight)
    T = poses(generator)
    assert (contact(surface, cloud, T).share > 0).any(), "some points beside an edge"
    found = alignment(surface, cloud, scales, T)
    for i in range(4):
        expected = numerical(
            lambda d, i=i: alignment(surface, cloud, scales, cloud.pivot.moved(T[i], d)[None]).cost[0]
        )
        assert torch.allclose(2 * found.gradient[i], expected, rtol=1e-4, atol=1e-6)


def test_the_hessian_is_symmetric_and_positive_semidefinite(generator: Generator) -> None:
    found = alignment(baked.toy(), baked.cloud(*baked.unseen()), SCALES, poses(generator, 8, 0.3)).hessian
    assert torch.allclose(found, found.mT, atol=1e-5 * float(found.abs().max()))
    least, most = torch.linalg.eigvalsh((found + found.mT) / 2)[:, [0, -1]].unbind(-1)
    assert (least > -1e-5 * most).all()


def on_surface(surface: SurfaceMap, T: SE3) -> Cloud:
    """Every surfel, as a camera at T would measure it."""
    points = T.inverse().apply(surface.surfels.positions.double())
    rgb = surface.surfels.rgb.double()
    return Cloud(points, rgb, torch.zeros_like(points))


def test_at_the_truth_there_is_no_cost_and_no_pull() -> None:
    surface, truth = baked.exact(baked.patch()), baked.unseen()[1].T_ref_camera
    cloud = on_surface(surface, truth)
    found = alignment(surface, cloud, SCALES, truth[None])
    assert found.cost.abs().max() < 1e-12
    assert found.gradient.abs().max() < 1e-12
    assert misfit(surface, cloud, SCALES, truth[None]) < 1e-12


def test_a_moved_world_changes_nothing(generator: Generator) -> None:
    """Moved by whole cells, and turned so that x, y, z become y, z, x: the grid turns with it."""
    surface, cloud = baked.exact(baked.toy()), exact_cloud()
    turn = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)
    T_new_world = SE3(turn, surface.cell * torch.tensor([3.0, -5.0, 11.0], dtype=torch.float64))
    parts, lower = surface.surfels, T_new_world.apply(torch.tensor(surface.grid.lower, dtype=torch.float64))
    (x, y, z), (a, b, c) = lower.tolist(), surface.grid.shape
    moved = SurfaceMap(
        Surfels(T_new_world.apply(parts.positions), parts.normals @ turn.T, parts.rgb, parts.rgb_gradient @ turn.T),
        VoxelGrid((x, y, z), surface.cell, (b, c, a)), surface.nearest_in_cell.permute(1, 2, 0).contiguous(),
        surface.keyframes,
    )  # fmt: skip
    T = poses(generator)
    here, there = (alignment(s, cloud, SCALES, t) for s, t in ((surface, T), (moved, T_new_world @ T)))
    assert torch.allclose(here.cost, there.cost, rtol=1e-9)
    assert torch.allclose(here.gradient, there.gradient, rtol=1e-6, atol=1e-9)
    assert torch.allclose(here.hessian, there.hessian, rtol=1e-6, atol=1e-6)


def test_many_poses_at_once_are_as_each_alone(generator: Generator) -> None:
    surface, cloud, T = baked.exact(baked.toy()), exact_cloud(), poses(generator)
    together = alignment(surface, cloud, SCALES, T)
    for i in range(4):
        alone = alignment(surface, cloud, SCALES, T[i : i + 1])
        assert torch.allclose(together.cost[i], alone.cost[0], rtol=1e-9)
        assert torch.allclose(together.hessian[i], alone.hessian[0], rtol=1e-9, atol=1e-9)


def beside(x: float) -> Cloud:
    """A point in the plane of the patch, whose edge is at 0.5."""
    return Cloud(torch.tensor([[x, 0.05, 0.05]]), torch.zeros((1, 3)), torch.zeros((1, 3)))


def test_a_point_beside_the_edge_is_pulled_back() -> None:
    surface, here = baked.patch(), SE3.identity()[None]
    for x, sign in ((0.8, 1), (-0.8, -1)):
        found = alignment(surface, beside(x), Scales(0.1, colour_weight=0.0), here)
        assert sign * float(found.gradient[0, 0]) > 0.1  # downhill is back
        assert found.gradient[0, 1:3].abs().max() < 1e-4
    inside = alignment(surface, beside(0.42), Scales(0.1, colour_weight=0.0), here)
    assert inside.cost.abs().max() < 1e-9
    assert inside.gradient.abs().max() < 1e-9


def test_the_misfit_of_a_shift_is_its_square() -> None:
    surface = baked.patch()
    cloud = Cloud(
        surface.surfels.positions + torch.tensor([0, 0, 0.03]), surface.surfels.rgb, torch.zeros((100, 3))
    )
    found = misfit(surface, cloud, Scales(0.1, colour_weight=0.0), SE3.identity()[None])
    assert float(found) == pytest.approx(0.09, rel=1e-4)


def test_an_update_turns_about_the_middle_of_the_cloud(generator: Generator) -> None:
    cloud, T = exact_cloud(), baked.unseen()[0].T_ref_camera
    delta = torch.randn((5, 6), generator=generator, dtype=torch.float64)
    delta[:, :3] = 0
    moved = cloud.pivot.moved(T, delta)
    assert torch.allclose(moved.apply(cloud.middle), T.apply(cloud.middle).expand(5, 3), atol=1e-12)
    assert torch.allclose(moved.rotation, (T.retract(delta)).rotation)
