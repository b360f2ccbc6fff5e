"""Checks of a field's sampler, and of renderings with it."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Generator, Tensor

from bidnerf_core.fields import (
    HitField,
    RadianceField,
    RayHits,
    Rays,
    RaySamples,
    Rendering,
    Stratified,
    render,
    rendering_weights,
)
from bidnerf_core.testing.faults import calling, require_that, sample
from bidnerf_core.testing.scene import SIDE, awkward_rays, joined, picked
from bidnerf_core.testing.values import close

SLACK = 1e-4 * SIDE  # metres: rounding error allowed in a distance
BACKGROUND = (0.1, 0.5, 0.9)


def check_intervals(field: RadianceField) -> None:
    """Check that valid samples are sorted, disjoint and in [near, far].

    Rays that miss have none, and there may be 0 rays.
    """
    for of, rays in awkward_rays().items():
        for jitter, how in ((None, ""), (_generator(), " with jitter")):
            _check_order(field, rays, sample(field, rays, of + how, jitter), of + how)
    for arranged in _arrangements():
        sample(field, arranged, f"rays arranged as {tuple(arranged.near.shape)}")


def _arrangements() -> Iterator[Rays]:
    """Yield rays with various numbers of axes, some of them without any ray."""
    for shape in ((), (1,), (2, 3), (0,), (2, 0)):
        index = torch.arange(torch.Size(shape).numel()).reshape(shape)
        yield picked(awkward_rays()["rays from outside"], index)


def _check_order(field: RadianceField, rays: Rays, samples: RaySamples, of: str) -> None:
    who = f"sampler {type(field.sampler).__name__} of {of}"
    starts, ends, valid = samples.starts, samples.ends, samples.valid
    finite = bool((starts.isfinite() & ends.isfinite()).all())
    require_that(
        finite, f"{who}: starts or ends are NaN or infinite; expected finite numbers, also where not valid"
    )
    require_that(
        bool((starts <= ends + SLACK)[valid].all()),
        f"{who}: an interval ends before it starts, or is not sorted",
    )
    reached = torch.where(valid, ends, -torch.inf).cummax(-1).values if starts.shape[-1] else ends
    overlap = (starts[..., 1:] < reached[..., :-1] - SLACK) & valid[..., 1:]
    require_that(
        not bool(overlap.any()), f"{who}: valid intervals overlap or are not sorted, expected nearest first"
    )
    within = (starts >= rays.near[..., None] - SLACK) & (ends <= rays.far[..., None] + SLACK)
    require_that(bool(within[valid].all()), f"{who}: a valid interval lies outside [near, far] of its ray")
    missed = rays.far <= rays.near
    require_that(
        not bool(valid[missed].any()), f"{who}: a ray with far <= near has valid samples, expected none"
    )


def check_repeatable(field: RadianceField) -> None:
    """Check that samples repeat without jitter and, with it, for the same seed of the given generator."""
    rays = joined(list(awkward_rays().values()))
    who = f"sampler {type(field.sampler).__name__}"
    with torch.random.fork_rng(devices=[]):
        twice = [sample(field, rays, "rays") for _ in range(2)]
        require_that(
            _same(*twice),
            f"{who}: two calls without jitter differ, expected no randomness without a generator",
        )
        jittered = [sample(field, rays, "rays with jitter", _generator()) for _ in range(2)]
    require_that(
        _same(*jittered),
        f"{who}: two calls with jitter of the same seed differ, expected all randomness to come from the given generator",
    )


def check_rays_alone(field: RadianceField) -> None:
    """Check that the rendering of a ray depends neither on the other rays nor on their arrangement."""
    rays = joined(list(awkward_rays().values()))
    count = len(rays.near) // 4 * 4
    whole = seen(field, picked(rays, torch.arange(count)), "rays")
    order = torch.randperm(count, generator=_generator())
    permuted = seen(field, picked(rays, order.reshape(4, -1)), "rays in another order").reshape(-1, 5)
    alone = torch.cat(
        [seen(field, picked(rays, torch.arange(i, i + 1)), "a ray") for i in range(0, count, 7)]
    )
    who = f"{type(field).__name__} rendered"
    expected = "expected each ray to be sampled for itself"
    require_that(
        close(permuted, whole[order], 1e-3), f"{who}: rays in another order see something else; {expected}"
    )
    require_that(
        close(alone, whole[::7], 1e-3),
        f"{who}: a ray alone sees something different from when among others; {expected}",
    )


def check_background(field: RadianceField) -> None:
    """Check that a ray that misses the scene sees only the background."""
    found = seen(field, awkward_rays()["rays that miss the scene"], "rays that miss the scene")
    require_that(
        close(found, torch.tensor([*BACKGROUND, 0.0, 0.0]).expand_as(found)),
        f"{type(field).__name__} rendered: a ray with far <= near does not see the background alone; is a sample valid"
        " there?",
    )


def check_levels(field: RadianceField) -> None:
    """Check that each level is a field and that the last one renders like the field itself."""
    offered = tuple(getattr(field, "levels", None) or (field,))
    for number, level in enumerate(offered):
        require_that(
            isinstance(level, RadianceField),
            f"levels[{number}] is a {type(level).__name__}, expected a field: an object with sampler and query",
        )
    rays = joined(list(awkward_rays().values()))
    require_that(
        close(seen(offered[-1], rays, "rays"), seen(field, rays, "rays"), 1e-3),
        f"{type(field).__name__}.levels: the last one renders otherwise than the field itself; expected the coarsest"
        " first and the field itself last",
    )


def check_hits(field: RadianceField) -> None:
    """Check the hits of a field that provides them.

    Values must be in range, distances in [near, far], and the opacity that of the field's density.
    """
    if not isinstance(field, HitField):
        return
    for of, rays in awkward_rays().items():
        _check_hits(field, rays, of)
    for arranged in _arrangements():
        shape = tuple(arranged.near.shape)
        found = _hits(field, arranged, f"rays arranged as {shape}")
        require_that(
            tuple(found.distance.shape[:-1]) == shape,
            f"{type(field).__name__}.hits of rays arranged as {shape}: distance has shape {tuple(found.distance.shape)},"
            " expected the rays' shape and one more axis",
        )
    _check_density(field, awkward_rays()["rays from outside"])


def _hits(field: HitField, rays: Rays, of: str) -> RayHits:
    with calling(f"{type(field).__name__}.hits of {of}"), torch.no_grad():
        return field.hits(rays)


def _check_hits(field: HitField, rays: Rays, of: str) -> None:
    found = _hits(field, rays, of)
    who = f"{type(field).__name__}.hits of {of}"
    for what, values in (("distance", found.distance), ("alpha", found.alpha), ("rgb", found.rgb)):
        require_that(bool(values.isfinite().all()), f"{who}: {what} is NaN or infinite, also where not valid")
    for what, values in (("alpha", found.alpha), ("rgb", found.rgb)):
        require_that(
            bool(((values >= 0) & (values <= 1)).all()),
            f"{who}: {what} is outside of [0, 1], expected within",
        )
    require_that(
        not bool((found.alpha[~found.valid] != 0).any()), f"{who}: alpha is not 0 where a hit is not valid"
    )
    distance, valid = found.distance, found.valid
    within = (distance >= rays.near[..., None] - SLACK) & (distance <= rays.far[..., None] + SLACK)
    require_that(bool(within[valid].all()), f"{who}: a valid hit lies outside [near, far] of its ray")


def _check_density(field: HitField, rays: Rays) -> None:
    """Check that the density of ``query``, summed along rays, absorbs as much light as the hits do."""
    hits = _hits(field, rays, "rays")
    expected = 1 - torch.prod(1 - hits.alpha, dim=-1)
    samples = Stratified(1024)(rays)
    with calling(f"{type(field).__name__}.query along rays"), torch.no_grad():
        places = rays.at(samples.middles)
        density = field.query(places, rays.directions[..., None, :].expand_as(places)).density
    found = rendering_weights(density, samples).sum(-1)
    off = (found - expected).abs()
    # The opacities must agree for nine rays out of ten.
    require_that(
        float((off <= 0.05).float().mean()) >= 0.9,
        f"{type(field).__name__}: query's density stops {float(found.mean()):.0%} of the light of rays on average and hits stop"
        f" {float(expected.mean()):.0%}, up to {float(off.max()):.0%} apart; expected the integral of the density along a ray to"
        " give the opacity of its hits",
    )


def seen(field: RadianceField, rays: Rays, of: str) -> Tensor:
    """Return rendered colour, distance and opacity as five channels (*r 5)."""
    with calling(f"render of {of} by {type(field).__name__}"), torch.no_grad():
        rendering: Rendering = render(field, rays, BACKGROUND)
    channels = [rendering.rgb, rendering.distance[..., None], rendering.opacity[..., None]]
    return torch.cat(channels, dim=-1)


def _same(a: RaySamples, b: RaySamples) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("starts", "ends", "valid"))


def _generator() -> Generator:
    return torch.Generator().manual_seed(3)
