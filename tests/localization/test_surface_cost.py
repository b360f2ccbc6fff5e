"""The cost of measured points on a surface: exact gradients, zero at the truth, the same in a moved world; point clouds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

import baked
from bidnerf_core.fields import Observations, VoxelGrid
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import PointCloud, PointScales, SurfaceCost
from bidnerf_core.mapping import SurfaceMap, SurfelIndex, Surfels
from tiny import depth_rays_of

SCALES = PointScales(0.1, 0.3, 0.7)


def poses(generator: Generator, count: int = 4, size: float = 0.05) -> SE3:
    """Return poses about that of the first unseen image."""
    near = size * torch.randn((count, 6), generator=generator, dtype=torch.float64)
    return baked.unseen()[0].T_ref_camera.retract(near)


def exact_cloud(count: int = 150) -> PointCloud:
    seen = baked.cloud(baked.unseen()[0], count=count)
    return baked.points(seen.points.double(), seen.rgb.double(), seen.origins.double())


def numerical(cost: Callable[[Tensor], Tensor], eps: float = 1e-6) -> Tensor:
    """Central differences of a scalar by a tangent at 0."""
    steps = eps * torch.eye(6, dtype=torch.float64)
    return torch.stack([(cost(d) - cost(-d)) / (2 * eps) for d in steps])


@pytest.mark.parametrize("colour_weight", [0.0, 0.7], ids=["distance", "colour"])
def test_the_gradient_is_that_of_the_cost(colour_weight: float, generator: Generator) -> None:
    surface, cloud = baked.exact(baked.toy()), exact_cloud()
    scales = replace(SCALES, colour_weight=colour_weight)
    T = poses(generator)
    cost = SurfaceCost(surface, cloud, scales)
    assert (cost.correspondences(T).beyond > 0).any(), "some points beside an edge"
    found = cost(T)
    for i in range(4):
        expected = numerical(lambda d, i=i: cost(cloud.pivot.moved(T[i], d)[None]).cost[0])
        assert torch.allclose(2 * found.gradient[i], expected, rtol=1e-4, atol=1e-6)


def test_the_hessian_is_symmetric_and_positive_semidefinite(generator: Generator) -> None:
    cost = SurfaceCost(baked.toy(), baked.cloud(*baked.unseen()), SCALES)
    found = cost(poses(generator, 8, 0.3)).hessian
    assert torch.allclose(found, found.mT, atol=1e-5 * float(found.abs().max()))
    least, most = torch.linalg.eigvalsh((found + found.mT) / 2)[:, [0, -1]].unbind(-1)
    assert (least > -1e-5 * most).all()


def on_surface(surface: SurfaceMap, T: SE3) -> PointCloud:
    """Return every surfel, as a camera at T would measure it."""
    points = T.inverse().apply(surface.surfels.positions.double())
    rgb = surface.surfels.rgb.double()
    return baked.points(points, rgb)


def test_at_the_truth_there_is_no_cost_and_no_pull() -> None:
    surface, truth = baked.exact(baked.patch()), baked.unseen()[1].T_ref_camera
    cloud = on_surface(surface, truth)
    cost = SurfaceCost(surface, cloud, SCALES)
    found = cost(truth[None])
    assert found.cost.abs().max() < 1e-12
    assert found.gradient.abs().max() < 1e-12
    assert cost.residual_variance(truth[None]) < 1e-12


def test_a_moved_world_changes_nothing(generator: Generator) -> None:
    """Moved by whole cells, and turned so that x, y, z become y, z, x: the grid turns with it."""
    surface, cloud = baked.exact(baked.toy()), exact_cloud()
    turn = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype=torch.float64)
    T_new_world = SE3(turn, surface.cell * torch.tensor([3.0, -5.0, 11.0], dtype=torch.float64))
    parts, lower = surface.surfels, T_new_world.apply(torch.tensor(surface.grid.lower, dtype=torch.float64))
    (x, y, z), (a, b, c) = lower.tolist(), surface.grid.shape
    surfels = Surfels(
        T_new_world.apply(parts.positions), parts.normals @ turn.T, parts.rgb, parts.rgb_gradient @ turn.T
    )
    grid = VoxelGrid((x, y, z), surface.cell, (b, c, a))
    moved = SurfaceMap(surfels, SurfelIndex.of(surfels.positions, grid), surface.keyframes)
    T = poses(generator)
    here, there = (SurfaceCost(s, cloud, SCALES)(t) for s, t in ((surface, T), (moved, T_new_world @ T)))
    assert torch.allclose(here.cost, there.cost, rtol=1e-9)
    assert torch.allclose(here.gradient, there.gradient, rtol=1e-6, atol=1e-9)
    assert torch.allclose(here.hessian, there.hessian, rtol=1e-6, atol=1e-6)


def test_many_poses_at_once_are_as_each_alone(generator: Generator) -> None:
    surface, cloud, T = baked.exact(baked.toy()), exact_cloud(), poses(generator)
    cost = SurfaceCost(surface, cloud, SCALES)
    together = cost(T)
    for i in range(4):
        alone = cost(T[i : i + 1])
        assert torch.allclose(together.cost[i], alone.cost[0], rtol=1e-9)
        assert torch.allclose(together.hessian[i], alone.hessian[0], rtol=1e-9, atol=1e-9)


def beside(x: float) -> SurfaceCost:
    """Return the cost of a point in the plane of the patch, whose edge is at 0.5."""
    point = baked.points(torch.tensor([[x, 0.05, 0.05]]), torch.zeros((1, 3)))
    return SurfaceCost(baked.patch(), point, PointScales(0.1, colour_weight=0.0))


def test_a_point_beside_the_edge_is_pulled_back() -> None:
    here = SE3.identity()[None]
    for x, sign in ((0.8, 1), (-0.8, -1)):
        found = beside(x)(here)
        assert sign * float(found.gradient[0, 0]) > 0.1  # downhill is back
        assert found.gradient[0, 1:3].abs().max() < 1e-4
    inside = beside(0.42)(here)
    assert inside.cost.abs().max() < 1e-9
    assert inside.gradient.abs().max() < 1e-9


def test_the_residual_variance_of_a_shift_is_its_square() -> None:
    surface = baked.patch()
    cloud = baked.points(surface.surfels.positions + torch.tensor([0, 0, 0.03]), surface.surfels.rgb)
    found = SurfaceCost(surface, cloud, PointScales(0.1, colour_weight=0.0)).residual_variance(
        SE3.identity()[None]
    )
    assert float(found) == pytest.approx(0.09, rel=1e-4)


def test_the_cost_alone_is_that_of_the_normal_equations(generator: Generator) -> None:
    for weight in (0.0, 0.7):
        cost = SurfaceCost(baked.toy(), baked.cloud(*baked.unseen()), replace(SCALES, colour_weight=weight))
        T = poses(generator, 5, 0.3)
        torch.testing.assert_close(cost.cost(T), cost(T).cost, rtol=1e-6, atol=1e-7)


def test_a_point_without_colour_counts_by_its_distance(generator: Generator) -> None:
    """Its colour, whatever it is, changes nothing; the gradient stays exact."""
    surface, cloud = baked.exact(baked.toy()), exact_cloud()
    coloured = torch.arange(len(cloud)) % 2 == 0
    clouds = [
        baked.points(cloud.points, torch.where(coloured[:, None], cloud.rgb, other), cloud.origins, coloured)
        for other in (0.0, 1.0)
    ]
    T = poses(generator)
    one, other = (SurfaceCost(surface, some, SCALES)(T) for some in clouds)
    assert torch.equal(one.cost, other.cost)
    assert torch.equal(one.hessian, other.hessian)
    cost = SurfaceCost(surface, clouds[0], SCALES)
    expected = numerical(lambda d: cost(cloud.pivot.moved(T[0], d)[None]).cost[0])
    assert torch.allclose(2 * one.gradient[0], expected, rtol=1e-4, atol=1e-6)


def test_an_update_turns_about_the_middle_of_the_cloud(generator: Generator) -> None:
    cloud, T = exact_cloud(), baked.unseen()[0].T_ref_camera
    delta = torch.randn((5, 6), generator=generator, dtype=torch.float64)
    delta[:, :3] = 0
    moved = cloud.pivot.moved(T, delta)
    assert torch.allclose(moved.apply(cloud.middle), T.apply(cloud.middle).expand(5, 3), atol=1e-12)
    assert torch.allclose(moved.rotation, (T.retract(delta)).rotation)


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
    cloud = baked.cloud(View(replace(frame, depth=depth), SE3.identity()), count=100)
    assert sorted(cloud.points[:, 2].tolist()) == pytest.approx([2.0, 3.0], rel=1e-6)
    colours = {tuple(row) for row in cloud.rgb.tolist()}
    assert colours == {tuple(frame.rgb[0, 1].tolist()), tuple(frame.rgb[1, 2].tolist())}


def test_without_depth_there_are_no_points() -> None:
    view = baked.unseen()[0]
    assert len(baked.cloud(with_depth(view, None))) == 0
    assert len(baked.cloud(with_depth(view, torch.zeros_like(view.frame.rgb[..., 0])))) == 0
    assert len(baked.cloud(with_depth(view, None), view, count=100)) == 50


def test_points_of_depth_rays_take_their_colours_from_the_views_that_see_them() -> None:
    """The pixels of a depth image, given as rays of their own, have the colours that the image shows there."""
    view = baked.unseen()[0]
    local = View(view.frame, SE3.identity())
    rays = depth_rays_of([local])
    found = PointCloud.measured(
        (with_depth(local, None),), rays, 2 * len(rays), torch.Generator().manual_seed(0)
    )
    assert len(found) == len(rays)
    assert found.all_coloured
    rows, columns = baked.CAMERA.project(found.points).long().flip(-1).unbind(-1)
    torch.testing.assert_close(found.rgb, view.frame.rgb[rows, columns])


def test_points_of_depth_rays_that_no_view_sees_have_no_colour() -> None:
    """A lidar sees all around; what is beside the image or behind the camera has no colour."""
    view = with_depth(View(baked.unseen()[0].frame, SE3.identity()), None)
    places = torch.tensor([[0.0, 0.0, 3.0], [9.0, 0.0, 3.0], [0.0, 0.0, -3.0]], dtype=torch.float64)
    rays = Observations.from_points(places, SE3.identity())
    found = PointCloud.measured((view,), rays, 100, torch.Generator().manual_seed(0))
    order = found.points[:, [0, 2]].round().tolist()
    assert sorted(order) == [[0.0, -3.0], [0.0, 3.0], [9.0, 3.0]]
    seen = {tuple(place): bool(c) for place, c in zip(order, found.coloured, strict=True)}
    assert seen == {(0.0, 3.0): True, (9.0, 3.0): False, (0.0, -3.0): False}
    assert not found.all_coloured
    assert not found.rgb[~found.coloured].any()
