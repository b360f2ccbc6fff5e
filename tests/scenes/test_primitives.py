"""Painted solids: what rays meet is where their implicit functions vanish."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import pytest
import torch
from scipy.optimize import brentq
from torch import Tensor

from bidnerf.scenes import Primitive, Shape, ball, blotches, box

# Inside: a solid and two textures that only the scenes for demonstrations use
from bidnerf.scenes.primitives import checker, cylinder, stripes
from bidnerf_core.geometry import SE3

PAINT = checker((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 0.5)
Implicit: TypeAlias = Callable[[Tensor], Tensor]
"""A function that is negative inside a solid and positive outside."""


def implicit_cylinder(points: Tensor, radius: float, half: float) -> Tensor:
    return torch.maximum(points[..., :2].norm(dim=-1) - radius, points[..., 2].abs() - half)


SOLIDS: dict[str, tuple[Shape, Implicit]] = {
    "ball": (ball(0.7), lambda points: points.norm(dim=-1) - 0.7),
    "box": (box((0.3, 0.6, 0.5)), lambda points: (points.abs() - points.new_tensor([0.3, 0.6, 0.5])).amax(-1)),
    "cylinder": (cylinder(0.5, 0.4), partial(implicit_cylinder, radius=0.5, half=0.4)),
    "disc": (cylinder(0.8, 0.01), partial(implicit_cylinder, radius=0.8, half=0.01)),
}
each_solid = pytest.mark.parametrize(("shape", "implicit"), SOLIDS.values(), ids=SOLIDS)


def random_rays(count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """(n 3) each, float64; origins in and about a shape of size one; most go past its middle, a third along an axis."""
    origins = (torch.rand((count, 3), generator=generator, dtype=torch.float64) * 2 - 1) * 1.5
    directions = torch.randn((count, 3), generator=generator, dtype=torch.float64) - origins
    axis = torch.eye(3, dtype=torch.float64)[torch.arange(count) % 3] * directions.sign()
    directions = torch.where((torch.arange(count) % 9 < 3)[:, None], axis, directions)
    return origins, torch.nn.functional.normalize(directions, dim=-1)


def placed(shape: Shape, generator: torch.Generator) -> Primitive:
    return Primitive(shape, SE3.exp(torch.randn(6, generator=generator, dtype=torch.float64) * 0.5), PAINT)


@each_solid
def test_distance_is_the_first_crossing_of_the_implicit_surface(
    shape: Shape, implicit: Implicit, generator: torch.Generator
) -> None:
    primitive = placed(shape, generator)
    origins, directions = random_rays(300, generator)
    distance = primitive.distance(origins.T, directions.T)
    steps = torch.linspace(0, 6, 6001, dtype=torch.float64)

    def level(ray: int, along: Tensor) -> Tensor:
        points = origins[ray] + along[..., None] * directions[ray]
        return implicit(primitive.T_world_shape.inverse().apply(points))

    compared = 0
    for ray in range(len(origins)):
        values = level(ray, steps)
        if values.abs().min() < 2e-3 and not values.min() < -2e-3:
            continue  # grazes: marching may step over it
        crossings = (values[:-1].sign() != values[1:].sign()).nonzero()
        if len(crossings) == 0:
            assert distance[ray] == math.inf
            continue
        i = int(crossings[0])
        ends = steps[i : i + 2].tolist()
        root = brentq(lambda t, r=ray: float(level(r, torch.tensor(t, dtype=torch.float64))), *ends, xtol=1e-13)
        assert float(distance[ray]) == pytest.approx(root, abs=1e-9)
        compared += 1
    assert compared > 25


@pytest.mark.parametrize("shape", [shape for shape, _ in SOLIDS.values()], ids=SOLIDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_distance_is_never_negative_or_nan(shape: Shape, dtype: torch.dtype, generator: torch.Generator) -> None:
    for primitive in (placed(shape, generator), Primitive(shape, SE3.identity(), PAINT)):
        origins, directions = (x.to(dtype).T for x in random_rays(5000, generator))
        for starts in (origins, 1e4 * origins, torch.zeros_like(origins)):
            distance = primitive.distance(starts, directions)
            assert (distance >= 0).all()  # false for NaN
        assert distance.isfinite().all() == (primitive.T_world_shape.translation == 0).all()  # left from within


@each_solid
def test_normals_are_the_gradient_of_the_implicit_function(
    shape: Shape, implicit: Implicit, generator: torch.Generator
) -> None:
    primitive = placed(shape, generator)
    origins, directions = random_rays(900, generator)
    distance = primitive.distance(origins.T, directions.T)
    hit = distance.isfinite()
    points = (origins + distance[:, None].nan_to_num(posinf=0) * directions)[hit].requires_grad_()
    local = primitive.T_world_shape.inverse().apply(points)
    (gradient,) = torch.autograd.grad(implicit(local).sum(), points)
    paint, normals = primitive.surface(points.detach().T)
    assert len(points) > 25
    torch.testing.assert_close(normals, gradient, atol=1e-9, rtol=0)
    torch.testing.assert_close(paint, PAINT(local.detach(), normals))


def test_textures_stay_in_range_and_vary(generator: torch.Generator) -> None:
    points = torch.rand((2000, 3), generator=generator, dtype=torch.float64) * 4 - 2
    for texture in (
        PAINT,
        stripes((1, 1, 1), (0, 0, 0), (1, 2, 0), 0.3),
        blotches((1, 1, 0), (0, 0, 1), 0.5, 3),
    ):
        rgb = texture(points, points)
        assert rgb.dtype == points.dtype
        assert ((rgb >= 0) & (rgb <= 1)).all()
        assert rgb.std(dim=0).max() > 0.2
