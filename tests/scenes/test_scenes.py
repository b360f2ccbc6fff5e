"""Closed-form scenes: their depth is exact, their frames agree with each other, their pictures are the right way up."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bidnerf.scenes import ClosedFormScene, demo_object, demo_room, look_around, orbit, views
from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import SE3, look_at
from optional import require

CAMERA = Intrinsics(70.0, 75.0, 31.0, 24.5, 64, 48)
SCENES = [demo_object(), demo_room()]


def random_rays(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """(n 3) each, float64; origins within the scenes or not far from them."""
    origins = torch.rand((count, 3), generator=generator, dtype=torch.float64) * 2.8 - 1.4
    directions = torch.randn((count, 3), generator=generator, dtype=torch.float64)
    return origins, torch.nn.functional.normalize(directions, dim=-1)


def views_of(scene: ClosedFormScene, count: int = 4) -> list[SE3]:
    inside = scene.name == "demo_room"
    return look_around(scene.bounds, count) if inside else orbit(3.2, count, elevation=(-40, 80))


@pytest.mark.parametrize("scene", SCENES, ids=lambda s: s.name)
def test_what_rays_meet_has_a_colour(scene: ClosedFormScene, generator: torch.Generator) -> None:
    origins, directions = random_rays(4000, generator)
    distance, rgb = scene.intersect(origins, directions)
    met = distance.isfinite()
    assert met.any()
    assert ((rgb >= 0) & (rgb <= 1)).all()
    if not met.all():
        assert (rgb[~met] == rgb.new_tensor(scene.bounds.background)).all()


@pytest.mark.parametrize("scene", SCENES, ids=lambda s: s.name)
def test_one_origin_for_all_is_the_same_as_one_for_each(scene: ClosedFormScene, generator: torch.Generator) -> None:
    _, directions = random_rays(600, generator)
    origin = torch.tensor([0.3, -1.4, 1.2], dtype=torch.float64)
    shared = scene.intersect(origin, directions.reshape(20, 30, 3))
    each = scene.intersect(origin.expand(20, 30, 3), directions.reshape(20, 30, 3))
    torch.testing.assert_close(shared[0], each[0], atol=0, rtol=0)
    torch.testing.assert_close(shared[1], each[1], atol=1e-12, rtol=0)


@pytest.mark.parametrize("scene", SCENES, ids=lambda s: s.name)
def test_all_matter_lies_within_the_bounds(scene: ClosedFormScene) -> None:
    for T in views_of(scene, 6):
        rays = T.rotate(torch.nn.functional.normalize(CAMERA.unproject(CAMERA.pixel_centres(torch.float64)), dim=-1))
        distance = scene.intersect(T.translation, rays)[0]
        limits = scene.bounds.rays(T.translation.expand_as(rays), rays)
        met = distance.isfinite()
        assert ((distance >= limits.near) & (distance <= limits.far))[met].all()


@pytest.mark.parametrize("scene", SCENES, ids=lambda s: s.name)
@pytest.mark.parametrize("distortion", [(), (-0.1, 0.02, 1e-3, -1e-3)], ids=["pinhole", "distorted"])
def test_depth_is_planar_and_exact_at_the_pixel_centre(scene: ClosedFormScene, distortion: tuple[float, ...]) -> None:
    camera, T = replace(CAMERA, distortion=distortion), views_of(scene)[1]
    frame = scene.render(camera, T)
    assert frame.depth is not None
    points = camera.unproject(camera.pixel_centres(torch.float64)) * frame.depth[..., None].double()
    away = T.apply(points) - T.translation
    seen = frame.depth > 0
    distance, _ = scene.intersect(T.translation, torch.nn.functional.normalize(away[seen], dim=-1))
    assert seen.any()
    assert torch.quantile((distance - away[seen].norm(dim=-1)).abs(), 0.99) < 1e-6  # silhouettes are ill-conditioned


@pytest.mark.parametrize("scene", SCENES, ids=lambda s: s.name)
def test_what_two_views_both_see_has_the_same_place_and_colour(scene: ClosedFormScene) -> None:
    T1 = views_of(scene, 12)[3]
    T2 = T1.retract(torch.tensor([0.15, -0.05, 0.1, 0.02, -0.05, 0.1], dtype=torch.float64))
    one, two = (view.frame for view in views(scene, CAMERA, [T1, T2]))
    assert one.depth is not None
    assert two.depth is not None
    points = T1.apply(CAMERA.unproject(CAMERA.pixel_centres(torch.float64)) * one.depth[..., None].double())
    points, rgb = points[one.depth > 0], one.rgb[one.depth > 0]
    there = T2.inverse().apply(points)
    pixel = CAMERA.project(there).floor()
    inside = ((pixel >= 0) & (pixel < pixel.new_tensor([CAMERA.width, CAMERA.height]))).all(-1)
    column, row = pixel[inside].long().unbind(-1)
    difference = two.depth[row, column].double() - there[inside][:, 2]
    visible = (difference.abs() < 0.03) & (two.depth[row, column] > 0)
    assert inside.float().mean() > 0.4
    assert visible.float().mean() > 0.85
    assert (rgb[inside] - two.rgb[row, column])[visible].abs().mean() < 0.05
    # From the second camera, something is met at each point or before it.
    ray = points[inside] - T2.translation
    length = ray.norm(dim=-1)
    assert (scene.intersect(T2.translation, ray / length[:, None])[0] <= length + 1e-5).float().mean() > 0.99


def test_moving_world_and_camera_leaves_the_depth_as_it_was() -> None:
    scene, T = demo_object(), orbit(3.0, 3)[1]
    move = SE3.exp(torch.tensor([0.4, -2.0, 1.0, 0.3, 1.0, -0.7], dtype=torch.float64))
    parts = [replace(p, T_world_shape=move @ p.T_world_shape) for p in scene.primitives]
    one, two = scene.render(CAMERA, T), replace(scene, primitives=parts).render(CAMERA, move @ T)
    torch.testing.assert_close(one.depth, two.depth, atol=1e-6, rtol=0)
    torch.testing.assert_close(one.alpha, two.alpha, atol=0.26, rtol=0)


def test_coverage_is_soft_at_contours_and_whole_in_rooms() -> None:
    T = orbit(3.0, 4)[2]
    frame = demo_object().render(CAMERA, T, name="seen")
    assert frame.name == "seen"
    assert frame.alpha is not None
    assert {0.0, 0.25, 0.5, 0.75, 1.0} == set(frame.alpha.unique().tolist())
    assert (frame.rgb[frame.alpha == 0] == 1).all()
    room = demo_room()
    for view in views(room, CAMERA, look_around(room.bounds, 3)):
        assert require(view.frame.alpha).min() == 1
        assert require(view.frame.depth).min() > 0.1


SYMMETRIES = [
    torch.diag(torch.tensor(signs, dtype=torch.float64))
    for signs in ((1, 1, -1), (1, -1, 1), (-1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1), (-1, -1, -1))
] + [torch.tensor([[0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)]


@pytest.mark.parametrize("scene", SCENES, ids=lambda s: s.name)
def test_no_symmetry_maps_a_scene_onto_itself(scene: ClosedFormScene) -> None:
    """Rays and their images under a symmetry about the middle of the scene meet other colours, or other depths."""
    middle = (torch.tensor(scene.bounds.lower) + torch.tensor(scene.bounds.upper)).double() / 2
    camera = CAMERA.scaled(0.5)
    for T in views_of(scene, 3):
        rays = T.rotate(torch.nn.functional.normalize(camera.unproject(camera.pixel_centres(torch.float64)), dim=-1))
        seen = scene.intersect(T.translation, rays)
        for symmetry in SYMMETRIES:
            other = scene.intersect(symmetry @ (T.translation - middle) + middle, rays @ symmetry.T)
            either = seen[0].isfinite() | other[0].isfinite()
            assert (seen[1] - other[1])[either].abs().mean() > 0.06


def test_pictures_are_upright_and_not_mirrored() -> None:
    """Seen from -y: +x lies to the right, +z above; the lorry's nose (+x) is at the right."""
    T = look_at((0.0, -4.0, 0.6), (0.0, 0.0, 0.0))
    assert bool(T.is_rigid(1e-12))
    (u0, v0), (u1, _), (_, v1) = CAMERA.project(
        T.inverse().apply(torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0, 0.5]]).double())
    )
    assert u1 > u0
    assert v1 < v0
    frame = demo_object().render(CAMERA, T)
    assert frame.alpha is not None
    red = (frame.rgb[..., 0] > 0.5) & (frame.rgb[..., 2] < 0.35) & (frame.rgb[..., 1] < 0.5)  # the cab
    columns = red.nonzero()[:, 1].double()
    assert columns.mean() > u0
    floor = demo_room().render(CAMERA, look_at((-1.0, 0.0, 1.4), (1.5, 0.0, 1.0)))
    assert floor.depth is not None
    assert floor.depth[-1].mean() < floor.depth[24].mean()


def test_bounds_of_scenes_have_room_for_a_camera() -> None:
    for scene in SCENES:
        assert math.hypot(*scene.bounds.size) <= scene.bounds.far
