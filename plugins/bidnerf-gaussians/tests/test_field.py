"""The field: what rays meet is what every Gaussian by itself gives, in order of depth."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module

import pytest
import torch
from torch import Tensor

from bidnerf_core.devices import without_waiting
from bidnerf_core.fields import Rays, SceneBounds, SplatField, render, scale_field
from bidnerf_core.geometry import SE3
from bidnerf_gaussians import Gaussians, GaussiansConfig, GaussiansField, quaternions
from bidnerf_gaussians.pieces import LEAST_ALPHA, Meeting, PieceField
from bidnerf_gaussians.spherical_harmonics import basis, colours

BOUNDS = SceneBounds((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0), 0.01, 10.0)


def field_of(gaussians: Gaussians) -> GaussiansField:
    field = GaussiansField(GaussiansConfig(gaussians=len(gaussians), degree=gaussians.degree), BOUNDS)
    field.assign(gaussians)
    return field.requires_grad_(False)


def rays(count: int = 60, seed: int = 3) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn((count, 3), generator=generator), dim=-1)
    origins = -3 * directions + 0.4 * torch.randn((count, 3), generator=generator)
    return Rays(origins, directions, torch.full((count,), 0.01), torch.full((count,), 10.0))


def by_each(gaussians: Gaussians, along: Rays) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return colour, mean distance and opacity of rays, by the precisions of all Gaussians, in float64."""
    R = quaternions.matrices(gaussians.quaternions.double())
    P = R @ torch.diag_embed((-2 * gaussians.log_scales.double()).exp()) @ R.mT
    d, o = along.directions.double()[:, None], along.origins.double()[:, None]
    away = gaussians.means.double() - o
    Pd = torch.einsum("nij,rnj->rni", P, d.expand_as(away))
    t = (Pd * away).sum(-1) / (Pd * d).sum(-1)
    x = t[..., None] * d - away
    alpha = gaussians.logits.double().sigmoid() * torch.exp(-0.5 * torch.einsum("rni,nij,rnj->rn", x, P, x))
    alpha = torch.where((alpha >= LEAST_ALPHA) & (t > along.near[:, None]), alpha, 0)
    order = t.argsort(dim=1)
    alpha, t = alpha.gather(1, order), t.gather(1, order)
    seen = colours(gaussians.harmonics.double()[order], d.expand(*t.shape, 3))
    weight = alpha * torch.cat([torch.ones_like(alpha[:, :1]), (1 - alpha).cumprod(1)[:, :-1]], dim=1)
    return (weight[..., None] * seen).sum(1), (weight * t).sum(1), weight.sum(1)


@pytest.mark.parametrize("count", [1, 3, 500])
def test_rays_see_all_gaussians_in_order_of_depth(some: Callable[..., Gaussians], count: int) -> None:
    gaussians = some(count, degree=2)
    found = render(field_of(gaussians), rays())
    rgb, distance, opacity = by_each(gaussians, rays())
    # light that is lost behind what stops all but one ten-thousandth of it is not looked for
    for value, expected in ((found.rgb, rgb), (found.distance, distance), (found.opacity, opacity)):
        assert torch.allclose(value.double(), expected, atol=1e-3)
    assert count < 500 or float(opacity.max()) > 0.5


def test_one_gaussian_alone() -> None:
    """Through its middle, alpha is the opacity; a standard deviation beside it, exp(-1/2) of that."""
    alone = Gaussians(
        torch.zeros(1, 3),
        torch.tensor([[0.1, 0.2, 0.4]]).log(),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([0.0]),
        torch.ones(1, 1, 3),
    )
    origins = torch.tensor([[0.0, 0, -3], [0.1, 0, -3], [0, 0.2, -3], [-3, 0, 0.4]])
    directions = torch.tensor([[0.0, 0, 1]] * 3 + [[1.0, 0, 0]])
    hits = field_of(alone).hits(Rays(origins, directions, torch.zeros(4), torch.full((4,), 10.0)))
    side = 0.5 * math.exp(-0.5)
    assert torch.allclose(hits.alpha[:, 0], torch.tensor([0.5, side, side, side]), atol=1e-6)
    assert torch.allclose(hits.distance[:, 0], torch.full((4,), 3.0), atol=1e-5)


def test_moved_with_the_rays_nothing_changes(some: Callable[..., Gaussians]) -> None:
    gaussians, along = some(200, degree=3), rays()
    T = SE3.exp(torch.tensor([0.3, -0.8, 0.5, 0.7, -1.9, 0.4], dtype=torch.float64))
    moved = gaussians.similar(2.5, T.rotation, T.translation)
    there = Rays(
        T.apply(2.5 * along.origins.double()).float(),
        T.rotate(along.directions.double()).float(),
        along.near,
        2.5 * along.far,
    )
    before, after = render(field_of(gaussians), along), render(field_of(moved), there)
    assert torch.allclose(before.rgb, after.rgb, atol=2e-3)
    assert torch.allclose(2.5 * before.distance, after.distance, atol=1e-2)


def test_in_known_shapes_the_same_is_seen(some: Callable[..., Gaussians], monkeypatch: pytest.MonkeyPatch) -> None:
    field, along = field_of(some(300)), rays()
    expected = render(field, along)
    points = rays(50, 5).at(torch.full((50, 1), 3.0))[:, 0]
    density = field.query(points, along.directions[:50])
    monkeypatch.setattr(import_module("bidnerf_gaussians.pieces"), "may_wait", lambda device: False)
    with without_waiting():
        found = render(field, along)
        again = field.query(points, along.directions[:50])
    assert torch.allclose(found.rgb, expected.rgb, atol=1e-3)
    assert torch.allclose(again.density, density.density, atol=1e-3 * float(density.density.max()))


def test_many_boxes_are_tested_in_parts(some: Callable[..., Gaussians], monkeypatch: pytest.MonkeyPatch) -> None:
    field, along = field_of(some(300)), rays()
    expected = field.hits(along)
    monkeypatch.setattr("bidnerf_gaussians.pieces.MOST_PAIRS", 400)
    found = field.hits(along)
    assert torch.equal(found.alpha, expected.alpha)


def test_transparent_gaussians_are_not_met(some: Callable[..., Gaussians]) -> None:
    gaussians = some(50)
    gone = replace(gaussians, logits=torch.full((50,), -20.0))
    assert field_of(gone).hits(rays()).alpha.shape[-1] == 0
    seen = render(field_of(gone), rays(), (0.1, 0.2, 0.3))
    assert torch.allclose(seen.rgb, torch.tensor([0.1, 0.2, 0.3]).expand_as(seen.rgb))


def test_harmonics_are_orthonormal() -> None:
    directions = torch.nn.functional.normalize(
        torch.randn((200_000, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=-1
    )
    values = basis(directions, 16)
    found = 4 * math.pi * values.mT @ values / len(values)
    assert torch.allclose(found, torch.eye(16, dtype=torch.float64), atol=0.03)


def test_quaternions_turn_as_their_matrices() -> None:
    q = torch.nn.functional.normalize(
        torch.randn((20, 4), generator=torch.Generator().manual_seed(1), dtype=torch.float64), dim=-1
    )
    v = torch.randn((20, 3), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    R = quaternions.matrices(q)
    assert torch.allclose(quaternions.turned_back(q, v), (R.mT @ v[..., None])[..., 0])
    assert torch.allclose(quaternions.matrices(quaternions.product(q, q.flip(0))), R @ R.flip(0))


def test_splats_are_the_gaussians_as_points(some: Callable[..., Gaussians]) -> None:
    gaussians = some(40, degree=1)
    field = field_of(gaussians)
    assert isinstance(field, SplatField)
    found, grown = field.splats(), scale_field(field, 2.0)
    assert isinstance(grown, SplatField)
    torch.testing.assert_close(found.positions, gaussians.means)
    torch.testing.assert_close(found.radius**3, gaussians.log_scales.exp().prod(-1))
    directions = torch.nn.functional.normalize(torch.randn((4000, 3)), dim=-1)
    linear = 0.5 + torch.einsum("pk,nkc->npc", basis(directions, 4), gaussians.harmonics)
    inside = ((linear > 0) & (linear < 1)).all(1).all(-1)  # where nothing is clipped, the first harmonic is the mean
    torch.testing.assert_close(found.rgb[inside], linear.mean(1)[inside], atol=0.02, rtol=0)
    torch.testing.assert_close(grown.splats().positions, 2 * found.positions)
    torch.testing.assert_close(grown.splats().radius, 2 * found.radius)


class Levels(PieceField):
    """Level pieces, each of which stops half of the light."""

    heights: Tensor

    def __init__(self, heights: list[float]) -> None:
        super().__init__()
        self.register_buffer("heights", torch.tensor(heights))
        self.register_tree(len(heights))
        centres = torch.nn.functional.pad(self.heights[:, None], (2, 0))
        halves = torch.tensor([1.0, 1.0, 0.01]).expand_as(centres)
        self.rebuild(centres, halves, torch.ones(len(heights), dtype=torch.bool))

    def meet(self, index: Tensor, origins: Tensor, directions: Tensor) -> Meeting:
        distance = (self.heights[index] - origins[:, 2]) / directions[:, 2]
        return Meeting(distance, torch.full_like(distance, 0.5), distance)

    def colours(self, index: Tensor, meeting: Meeting, directions: Tensor) -> Tensor:
        return torch.ones_like(directions)

    def profile(self, meeting: Meeting) -> Tensor:
        return (meeting.distance.abs() < 0.1) / 0.2

    def half_length(self, meeting: Meeting) -> Tensor:
        return torch.full_like(meeting.distance, 0.1)


def test_samples_lie_about_pieces_and_divide_what_overlaps() -> None:
    """The second ray ends within the interval of the last piece."""
    down, zero = torch.tensor([[0.0, 0.0, -1.0]] * 2), torch.zeros(2)
    rays = Rays(torch.tensor([[0.0, 0.0, 3.0]] * 2), down, zero, torch.tensor([10.0, 4.05]))
    samples = Levels([-1.0, 0.12, 0.0]).sampler(rays)
    assert bool(samples.valid.all())
    torch.testing.assert_close(samples.starts, torch.tensor([[2.78, 2.94, 3.9]] * 2))
    torch.testing.assert_close(samples.ends, torch.tensor([[2.94, 3.1, 4.1], [2.94, 3.1, 4.05]]))
