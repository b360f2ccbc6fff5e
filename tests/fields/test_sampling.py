"""Laws of importance sampling over samplers of any kind: with gaps, with samples that are not valid, with none at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Generator

from balls import HomogeneousBall
from bidnerf.scenes import GaussianBlobs
from bidnerf.testing import check_background, check_intervals, check_rays_alone, check_repeatable
from bidnerf_adanerf.bins import Bins
from bidnerf_core.fields import (
    FieldValues,
    Importance,
    RadianceField,
    Rays,
    RaySampler,
    RaySamples,
    SceneBounds,
    Stratified,
    render,
)
from bidnerf_hashgrid.concentration import Concentrated
from bidnerf_hashgrid.occupancy import OccupancyGrid
from voxels import cell_centres

BOUNDS = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.05, 8.0)
COUNT = 9


def shell(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    """Invalid samples amid valid ones: nothing within half a metre of the middle."""
    samples = Stratified(12)(rays, jitter)
    return RaySamples(samples.starts, samples.ends, samples.valid & (rays.at(samples.middles).norm(dim=-1) > 0.5))


def apart(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    """Each interval only half as long as there is room."""
    samples = Stratified(12)(rays, jitter)
    return RaySamples(samples.starts, samples.middles, samples.valid)


def grid() -> OccupancyGrid:
    cells = OccupancyGrid(BOUNDS, 8)
    cells.restrict(torch.rand((8, 8, 8), generator=Generator().manual_seed(0)) < 0.3)
    return cells


def nothing(rays: Rays, jitter: Generator | None = None) -> RaySamples:
    none = rays.near.new_zeros((*rays.near.shape, 0))
    return RaySamples(none, none, none.bool())


SAMPLERS: dict[str, Callable[[], RaySampler]] = {
    "contiguous": lambda: Stratified(12),
    "invalid": lambda: shell,
    "gaps": lambda: apart,
    "grid": grid,
    "none": lambda: nothing,
}


def rays(count: int = 200) -> Rays:
    generator = Generator().manual_seed(1)
    origins = 3 * torch.nn.functional.normalize(torch.randn((count, 3), generator=generator), dim=-1)
    targets = 0.8 * torch.randn((count, 3), generator=generator)  # some miss
    return BOUNDS.rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1))


def finer(sampler: RaySampler) -> Importance:
    return Importance(replace(GaussianBlobs.random(), sampler=sampler), COUNT)


def fewer(sampler: RaySampler, count: int = COUNT) -> Concentrated:
    return Concentrated(replace(GaussianBlobs.random(), sampler=sampler), count)


@pytest.mark.parametrize("made", [lambda sampler: sampler, finer, fewer], ids=["rough", "finer", "fewer"])
@pytest.mark.parametrize("name", SAMPLERS)
def test_the_contracts_laws_hold(name: str, made: Callable[[RaySampler], RaySampler]) -> None:
    field = replace(GaussianBlobs.random(), sampler=made(SAMPLERS[name]()))
    for law in (check_intervals, check_repeatable, check_rays_alone, check_background):
        law(field)


@pytest.mark.parametrize("jittered", [False, True])
@pytest.mark.parametrize("sampler", [Stratified(16), Bins(BOUNDS, 16)], ids=["stratified", "bins"])
def test_contiguous_intervals_tile_the_ray(sampler: RaySampler, jittered: bool) -> None:
    where = rays(50)
    hits = where.far > where.near
    samples = sampler(where, Generator().manual_seed(0) if jittered else None)
    assert torch.equal(samples.valid, hits[:, None].expand(50, 16))
    torch.testing.assert_close(samples.starts[hits][:, 1:], samples.ends[hits][:, :-1])
    torch.testing.assert_close(samples.starts[hits][:, 0], where.near[hits])
    torch.testing.assert_close(samples.ends[hits][:, -1], where.far[hits])
    if not jittered:
        width = (where.far - where.near)[:, None].expand(-1, 16) / 16
        torch.testing.assert_close((samples.ends - samples.starts)[hits], width[hits], atol=1e-5, rtol=0)


@pytest.mark.parametrize("jittered", [False, True])
@pytest.mark.parametrize("name", [name for name in SAMPLERS if name != "none"])
def test_what_was_covered_stays_covered_and_nothing_else(name: str, jittered: bool) -> None:
    """At any distance along a ray, the cut intervals say what the rough ones say."""
    sampler, where = SAMPLERS[name](), rays()
    rough, cut = (s(where, Generator().manual_seed(2) if jittered else None) for s in (sampler, finer(sampler)))
    share = torch.rand((200, 300), generator=Generator().manual_seed(3))
    distances = where.near[:, None] + share * (where.far - where.near)[:, None]

    def covers(samples: RaySamples) -> torch.Tensor:
        inside = (samples.starts[:, None] <= distances[..., None]) & (distances[..., None] < samples.ends[:, None])
        return (inside & samples.valid[:, None]).sum(-1)

    assert int(covers(cut).max()) == 1
    agree = covers(rough).clamp(max=1) == covers(cut)
    assert float(agree.float().mean()) > 0.9999  # but for rounding at borders


def test_borders_of_a_contiguous_sampler_are_sorted_together() -> None:
    """Intervals leave no gaps and have the borders of both, in order (Mildenhall et al. 2020, section 5.2)."""
    where = rays()
    hits = where.far > where.near
    rough, cut = Stratified(12)(where), finer(Stratified(12))(where)
    borders = torch.cat([cut.starts, cut.ends[..., -1:]], dim=-1)[hits]
    assert torch.equal(cut.starts[hits][:, 1:], cut.ends[hits][:, :-1])
    assert bool((borders.diff(dim=-1) >= 0).all())
    assert bool(torch.isin(rough.starts[hits], borders).all())


def shell_cells() -> OccupancyGrid:
    """The cells about a sphere of 0.8 m, and gaps inside and out."""
    cells = OccupancyGrid(BOUNDS, 8)
    cells.restrict((cell_centres(cells.grid).norm(dim=-1) - 0.8).abs() < 0.3)
    return cells


SURFACES: dict[str, tuple[RaySampler, Callable[[RadianceField], RaySampler], float]] = {
    "importance": (Stratified(48), lambda ball: Importance(replace(ball, sampler=Stratified(16)), 32), 0.7),
    "in a grid": (shell_cells(), lambda ball: Importance(replace(ball, sampler=shell_cells()), 64), 0.5),
    "concentrated": (Stratified(12), lambda ball: Concentrated(replace(ball, sampler=Stratified(256)), 12), 0.25),
}
"""Even samples, those put where a ball's surface is, and how much smaller the error of its distance then is."""


@pytest.mark.parametrize("name", SURFACES)
def test_a_surface_is_seen_where_it_is(name: str) -> None:
    """On smooth blobs, even spacing is as good as it gets."""
    ball, where = HomogeneousBall(0.8, 40.0), rays(300)
    even, put, share = SURFACES[name]
    exact = render(replace(ball, sampler=Stratified(4000)), where)
    hit = exact.opacity > 0.99
    assert int(hit.sum()) > 50
    seen = [render(replace(ball, sampler=sampler), where) for sampler in (put(ball), even)]
    errors = [float((found.distance - exact.distance).abs()[hit].median()) for found in seen]
    assert errors[0] < share * errors[1]
    assert float((seen[0].opacity - exact.opacity).abs().mean()) < 0.05


# Concentration.


@pytest.mark.parametrize("jittered", [False, True])
@pytest.mark.parametrize("name", SAMPLERS)
def test_concentrated_samples_are_few_and_as_long_as_those_they_replace(name: str, jittered: bool) -> None:
    where = rays()
    jitter = Generator().manual_seed(3) if jittered else None
    rough = SAMPLERS[name]()(where, Generator().manual_seed(3) if jittered else None)
    found = fewer(SAMPLERS[name]())(where, jitter)

    def length(samples: RaySamples) -> torch.Tensor:
        return torch.where(samples.valid, samples.ends - samples.starts, 0).sum(-1)

    assert int(found.valid.sum(-1).max() if found.valid.numel() else 0) <= COUNT
    # An interval that reaches over a gap may lose part of its length to its neighbour.
    lost = (length(rough) - length(found)) / length(rough).clamp(min=1e-9)
    assert float(lost.abs().mean()) < 0.02


def test_few_samples_are_kept_as_they_are() -> None:
    where, rough = rays(), Stratified(COUNT)
    kept = fewer(rough)(where)
    assert all(torch.equal(getattr(kept, part), getattr(rough(where), part)) for part in ("starts", "ends", "valid"))


class TwoWalls:
    """Walls at 1 and 3 metres from where rays begin, each as thick as one of 256 intervals and as dense as can be."""

    sampler = Stratified(256)

    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        step = 4.0 / 256
        there = [(positions[..., 2] - at).abs() < 0.6 * step for at in (1.0, 3.0)]
        return FieldValues((there[0] | there[1]) * 1e6, torch.zeros_like(positions))


def test_what_lies_behind_an_opaque_cell_of_the_guide_is_sampled_too() -> None:
    """A guide's density is that of the densest part of a cell, past which a ray may go."""
    where = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]), torch.zeros(1), torch.full((1,), 4.0))
    found = Concentrated(TwoWalls(), 32)(where)
    near = [int(((found.middles - at).abs() < 0.05).sum()) for at in (1.0, 3.0)]
    assert near[0] > near[1] >= 5


def test_stratified_samples_of_an_open_scene_are_even_in_its_coordinate() -> None:
    bounds = replace(BOUNDS, far=300.0, contracted=True)
    where = bounds.rays(
        torch.zeros(5, 3),
        torch.nn.functional.normalize(torch.randn(5, 3, generator=Generator().manual_seed(2)), dim=-1),
    )
    samples = Stratified(40, bounds)(where)
    widths = bounds.spacing(where).coordinate(samples.ends) - bounds.spacing(where).coordinate(samples.starts)
    torch.testing.assert_close(widths, widths.mean(-1, keepdim=True).expand_as(widths), rtol=1e-2, atol=1e-4)
    torch.testing.assert_close(samples.starts[:, 0], where.near)
    torch.testing.assert_close(samples.ends[:, -1], where.far, rtol=1e-3, atol=0)
