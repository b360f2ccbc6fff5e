"""Carving and bounds: nothing that is there is ever cut away, and much of what is not there is."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.carving import FreeSpace, estimate_bounds, occupied_cells

# Inside: the constants and measured points from which bounds are computed, to compare the bounds with
from bidnerf_core.carving.bounds import measured_points
from bidnerf_core.datasets import open_dataset
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3, look_at
from optional import require

CAMERA = Intrinsics(60.0, 58.0, 33.0, 23.0, 64, 48)
LENS = replace(CAMERA, distortion=(-0.2, 0.05, 0.001, -0.002))
BALL = (0.3, -0.2, 0.1)  # middle
RADIUS = 0.7
LOWER, UPPER = (-1.5, -1.5, -1.5), (1.5, 1.5, 1.5)
SHAPE = (24, 26, 28)  # no whole number of blocks


@functools.cache
def ball_depth(place: tuple[float, ...], camera: Intrinsics, radius: float) -> Tensor:
    """Planar depth of the ball, which lies in a world, seen from a place outside; 0 beside it."""
    rays = camera.unproject(camera.pixel_centres(torch.float64))
    middle = look_at(place, (0, 0, 0)).inverse().apply(torch.tensor(BALL).double())
    a, b = (rays * rays).sum(-1), (rays @ middle)
    return ((b - (b * b - a * (middle @ middle - radius**2)).sqrt()) / a).nan_to_num(0).float()


def ball_view(
    place: tuple[float, ...],
    camera: Intrinsics = CAMERA,
    depth: bool = True,
    alpha: bool = True,
    radius: float = RADIUS,
) -> View:
    z = ball_depth(place, camera, radius).clone()
    hit = (z > 0).float()
    frame = Frame("ball", hit[..., None].expand(*hit.shape, 3), camera, z if depth else None, hit if alpha else None)
    return View(frame, look_at(place, (0, 0, 0)))


def around(count: int = 8, distance: float = 4.0) -> list[tuple[float, float, float]]:
    """Places on a sphere, on both sides of the equator."""
    places = []
    for i in range(count):
        height, turn = 0.8 * math.sin(1.7 * i), 2.4 * i
        flat = math.sqrt(1 - height**2)
        places.append((distance * flat * math.cos(turn), distance * flat * math.sin(turn), distance * height))
    return places


def ball_views(**options: bool) -> list[View]:
    return [ball_view(place, **options) for place in around()]  # type: ignore[arg-type]


def middles(shape: tuple[int, int, int]) -> Float[Tensor, "nx ny nz 3"]:
    axes = [low + (torch.arange(n) + 0.5) * (high - low) / n for n, low, high in zip(shape, LOWER, UPPER, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def on_surface(shape: tuple[int, int, int] = SHAPE) -> Tensor:
    off = torch.linalg.vector_norm(middles(shape) - torch.tensor(BALL), dim=-1) - RADIUS
    far_corner = [low + (up - low) / n for n, low, up in zip(shape, LOWER, UPPER, strict=True)]
    return off.abs() <= math.dist(LOWER, far_corner) / 2


def inside(shape: tuple[int, int, int] = SHAPE) -> Tensor:
    return torch.linalg.vector_norm(middles(shape) - torch.tensor(BALL), dim=-1) <= RADIUS


# Cells


@pytest.mark.parametrize("camera", [CAMERA, LENS], ids=["ideal", "lens"])
@pytest.mark.parametrize(("depth", "alpha"), [(True, True), (False, True), (True, False)])
def test_no_matter_is_cut_away_and_most_air_is(depth: bool, alpha: bool, camera: Intrinsics) -> None:
    views = [ball_view(place, camera, depth, alpha) for place in around()]
    occupied = occupied_cells(views, LOWER, UPPER, SHAPE)
    assert occupied.shape == SHAPE
    assert occupied[inside()].all()
    assert occupied[on_surface()].all()
    if alpha:
        assert occupied.double().mean() < 2.2 * (inside() | on_surface()).double().mean()


def test_a_wall_of_depth_empties_what_is_before_it() -> None:
    """A view from the side, a wall at z = 3: cells nearer are free but for the margin, those behind are not known."""
    view = View(Frame("wall", torch.zeros(48, 64, 3), CAMERA, torch.full((48, 64), 3.0)), SE3.identity())
    shape = (2, 2, 40)
    occupied = occupied_cells([view], (-0.2, -0.2, 0.0), (0.2, 0.2, 4.0), shape, tolerance=0.02, footprint=16)
    z = (torch.arange(40) + 0.5) / 10
    radius = math.sqrt(0.1**2 + 0.1**2 + 0.05**2)
    free = ~occupied[0, 0]
    assert not free[z + radius >= 3 * 0.98].any()
    assert free[(z > 1) & (z + radius < 3 * 0.98)].all()
    assert occupied[..., z < 0.2].all()  # too near: the cell covers too many pixels


def test_unknown_depth_frees_nothing() -> None:
    depth = torch.full((48, 64), 3.0)
    depth[:, 32:] = 0
    view = View(Frame("holes", torch.zeros(48, 64, 3), CAMERA, depth), SE3.identity())
    occupied = occupied_cells([view], (-0.6, -0.2, 1.0), (0.6, 0.2, 2.0), (24, 8, 20))
    x = (torch.arange(24) + 0.5) * 0.05 - 0.6
    assert occupied[x > 0].all()
    assert not occupied[5, 4, 10]


def test_two_views_must_agree_where_there_are_two() -> None:
    free = ball_view((4, 0, 0), radius=0.01)  # sees next to nothing
    assert (~occupied_cells([free], LOWER, UPPER, SHAPE)).any()
    elsewhere = replace(free, T_ref_camera=look_at((40, 0, 0), (80, 0, 0)))
    assert occupied_cells([free, elsewhere], LOWER, UPPER, SHAPE).all()
    again = occupied_cells([free, free], LOWER, UPPER, SHAPE)
    assert torch.equal(again, occupied_cells([free], LOWER, UPPER, SHAPE))


def test_colour_alone_and_soft_edges_empty_nothing() -> None:
    view = ball_view((4, 0, 0))
    soft = replace(view, frame=replace(view.frame, alpha=torch.full((48, 64), 0.01)))
    for views in (ball_views(depth=False, alpha=False), [], [soft]):
        assert occupied_cells(views, LOWER, UPPER, SHAPE).all()


def test_order_of_views_does_not_matter() -> None:
    views = ball_views()
    one = occupied_cells(views, LOWER, UPPER, SHAPE)
    assert torch.equal(one, occupied_cells(views[::-1], LOWER, UPPER, SHAPE))


def test_many_views_do_not_make_votes_overflow() -> None:
    views = [ball_view(place) for place in around(2)]
    once = occupied_cells(views, LOWER, UPPER, (8, 8, 8))
    assert torch.equal(once | occupied_cells(views * 128, LOWER, UPPER, (8, 8, 8)), once)


def test_a_far_and_large_world_is_the_same_world() -> None:
    """Metres or millimetres, here or a thousand kilometres away."""
    scale, shift = 1000.0, torch.tensor([1e9, -2e9, 3e8], dtype=torch.float64)
    moved = [in_other_units(view, scale, shift) for view in ball_views()]
    lower, upper = ([x * scale + s for x, s in zip(end, shift.tolist(), strict=True)] for end in (LOWER, UPPER))
    far = occupied_cells(moved, (lower[0], lower[1], lower[2]), (upper[0], upper[1], upper[2]), SHAPE)
    here = occupied_cells(ball_views(), LOWER, UPPER, SHAPE)
    assert (far != here).double().mean() < 1e-3


def in_other_units(view: View, scale: float, shift: Float[Tensor, "3"]) -> View:
    pose = SE3(view.T_ref_camera.rotation, view.T_ref_camera.translation * scale + shift)
    depth, seen = view.frame.depth, view.landmarks
    if seen is not None:
        seen = replace(seen, distance=scale * seen.distance, deviation=scale * seen.deviation)
    return View(view.frame.replace(depth=None if depth is None else depth * scale), pose, landmarks=seen)


def test_large_images_are_shrunk_and_still_safe() -> None:
    camera = CAMERA.scaled(14)  # 896 x 672, a factor of 3 with rests
    views = [ball_view(place, camera) for place in around(4)]
    assert FreeSpace.seen_by(views[0]).levels.shape == (9, 224, 299)
    occupied = occupied_cells(views, LOWER, UPPER, SHAPE, footprint=20)
    assert occupied[inside() | on_surface()].all()
    assert occupied.double().mean() < 0.6


@given(
    x=st.floats(-2, 2),
    y=st.floats(-2, 2),
    z=st.floats(0.3, 6),
    radius=st.floats(0.001, 0.29),
    lens=st.booleans(),
)
def test_a_freed_sphere_is_wholly_in_the_free(x: float, y: float, z: float, radius: float, lens: bool) -> None:
    """Points all over the sphere are seen on free pixels, and before what those measured."""
    view = ball_view((4, 0, 0), LENS if lens else CAMERA)
    space = FreeSpace.seen_by(view, tolerance=0.02)
    if not space.frees(torch.tensor([[x], [y], [z]]), radius).item():
        return
    around_it = torch.nn.functional.normalize(torch.randn(400, 3), dim=-1) * radius + torch.tensor([x, y, z])
    pixels = view.frame.intrinsics.project(around_it).floor().long()
    assert ((pixels >= 0) & (pixels < torch.tensor([64, 48]))).all()
    depth, alpha = view.frame.depth, view.frame.alpha
    behind = around_it[:, 2] > require(depth)[pixels[:, 1], pixels[:, 0]]
    assert not (behind & (require(alpha)[pixels[:, 1], pixels[:, 0]] > 0)).any()


# Bounds


def holds(bounds: SceneBounds, points: Float[Tensor, "n 3"]) -> float:
    """The part of the points that are in the box."""
    lower, upper = (torch.tensor(end, dtype=torch.float64) for end in (bounds.lower, bounds.upper))
    return ((points >= lower) & (points <= upper)).all(dim=-1).double().mean().item()


@pytest.mark.parametrize(("depth", "alpha"), [(True, True), (False, True), (True, False), (False, False)])
def test_the_box_holds_the_ball(depth: bool, alpha: bool) -> None:
    bounds = estimate_bounds(ball_views(depth=depth, alpha=alpha), (0.1, 0.2, 0.3))
    ends = torch.tensor(BALL).double() + RADIUS * 0.97 * torch.cat([torch.eye(3), -torch.eye(3)]).double()
    assert holds(bounds, ends) == 1
    assert bounds.background == (0.1, 0.2, 0.3)
    if depth or alpha:
        assert max(bounds.size) < 2 * RADIUS * (1.2 if depth else 1.5)
    assert 0 < bounds.near < 4 - RADIUS - math.dist(BALL, (0, 0, 0))
    farthest = max(
        math.dist(place, (x, y, z))
        for place in around()
        for x in (bounds.lower[0], bounds.upper[0])
        for y in (bounds.lower[1], bounds.upper[1])
        for z in (bounds.lower[2], bounds.upper[2])
    )
    assert bounds.far >= farthest


@pytest.mark.parametrize(("depth", "alpha"), [(True, False), (False, True), (False, False)])
def test_bounds_know_no_unit_and_no_origin(depth: bool, alpha: bool) -> None:
    views, shift = ball_views(depth=depth, alpha=alpha), torch.tensor([5.0, -300, 20]).double()
    here, there = estimate_bounds(views), estimate_bounds([in_other_units(view, 50, shift) for view in views])
    for one, other in ((here.lower, there.lower), (here.upper, there.upper)):
        torch.testing.assert_close(
            torch.tensor(one).double() * 50 + shift, torch.tensor(other).double(), atol=0.5, rtol=0
        )
    assert there.near == pytest.approx(50 * here.near, rel=1e-2)
    assert there.far == pytest.approx(50 * here.far, rel=1e-2)


def test_wild_measurements_do_not_move_the_box() -> None:
    views = ball_views(alpha=False)
    calm = estimate_bounds(views)
    for view in views:
        # Of some 400 measured pixels of a view, one each.
        require(view.frame.depth)[0, :2] = torch.tensor([1000.0, 1e-4])
    wild = estimate_bounds(views)
    assert max(wild.size) < 2000  # one in 400 is more than may be wild: the box tells of it ...
    for view in views[1:]:
        require(view.frame.depth)[0, :2] = 0
    assert max(estimate_bounds(views).size) < 1.1 * max(calm.size)  # ... one in 4000 is not


def test_opaque_alpha_is_no_silhouette() -> None:
    views = ball_views(depth=False, alpha=False)
    opaque = [replace(v, frame=replace(v.frame, alpha=torch.ones(48, 64))) for v in views]
    assert estimate_bounds(opaque) == estimate_bounds(views)


def test_cameras_that_look_outward_are_in_the_box() -> None:
    views = ball_views(depth=False, alpha=False)
    outward = [replace(v, T_ref_camera=look_at(p, [2 * x for x in p])) for v, p in zip(views, around(), strict=True)]
    bounds = estimate_bounds(outward)
    places = torch.tensor(around()).double()
    assert holds(bounds, torch.cat([places, places * 2])) == 1
    assert bounds.near < 0.05 * bounds.far


def test_cameras_that_look_one_way_see_the_box_before_them() -> None:
    """A capture of a wall: parallel axes do not meet."""
    view = ball_view((4, 0, 0), depth=False, alpha=False)
    views = [replace(view, T_ref_camera=look_at((4, 0.1 * i, 0), (0, 0.1 * i, 0))) for i in range(5)]
    bounds = estimate_bounds(views)
    assert bounds.lower[0] < 4 - 1
    assert bounds.upper[0] == pytest.approx(4)


def test_a_flat_scene_gets_some_thickness() -> None:
    view = View(Frame("wall", torch.zeros(48, 64, 3), CAMERA, torch.full((48, 64), 3.0)), SE3.identity())
    bounds = estimate_bounds([view])
    assert bounds.lower[2] < 3 < bounds.upper[2]
    assert bounds.near == pytest.approx(1.5, rel=0.05)


def test_too_little_information_is_refused() -> None:
    with pytest.raises(InputError, match="no views"):
        estimate_bounds([])


def test_views_from_one_place_have_an_assumed_scale_and_matter_beyond() -> None:
    view = ball_view((4, 0, 0), depth=False, alpha=False)
    bounds = estimate_bounds([view, view])
    assert bounds.contracted
    assert holds(bounds, view.T_ref_camera.translation[None]) == 1
    assert bounds.side == pytest.approx(4 * 1, rel=0.8)


# Recorded scenes


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("scene", ["blender_lego", "tum_fr1_xyz", "room_living"])
def test_recorded_scenes_lie_in_their_box(data_dir: Path, scene: str) -> None:
    """Bounds and cells from one split hold what the other measured."""
    dataset = open_dataset(data_dir / scene)
    train, test = (dataset.views(split, dataset.frame_names(split)[::8]) for split in ("train", "test"))
    bounds = estimate_bounds(train, dataset.background)
    points = torch.cat([measured_points(view, 2000)[0] for view in test])
    assert holds(bounds, points) >= 0.995
    if scene == "blender_lego":
        assert max(bounds.size) < 3
    occupied = occupied_cells(train, bounds.lower, bounds.upper, (64, 64, 64))
    lower, upper = torch.tensor(bounds.lower).double(), torch.tensor(bounds.upper).double()
    cells = ((points - lower) / (upper - lower) * 64).long()
    cells = cells[((cells >= 0) & (cells < 64)).all(dim=-1)]
    assert occupied[tuple(cells.T)].double().mean() > 0.97
    assert occupied.double().mean() < 0.98
