"""Checks of a field: its values, their derivatives, its sampler, and renderings with it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.testing.faults import calling, generator, query, require, sample
from bidnerf.testing.scene import (
    SIDE,
    awkward_points,
    awkward_rays,
    camera_rays,
    points,
    rgbd_views,
)
from bidnerf_core.fields import (
    DifferentiatedField,
    FieldValues,
    HitField,
    RadianceField,
    RayHits,
    Rays,
    RaySamples,
    Stratified,
    backward_derivatives,
    render,
    rendering_weights,
)

# Values.


def check_shapes(field: RadianceField) -> None:
    """Check that points may have any leading axes, including empty ones, and that values do not depend on this arrangement."""
    positions, directions = points(7)
    flat = to_channels(query(field, positions, directions, "7 points"))
    for shape in ((), (7,), (1,), (2, 3), (2, 1, 3), (0,), (2, 0), (0, 3)):
        count = torch.Size(shape).numel()
        places, towards = (x[:count].reshape(*shape, 3) for x in (positions, directions))
        values = to_channels(query(field, places, towards, f"points arranged as {shape}"))
        require(
            f"{type(field).__name__}.query",
            (
                close(values.reshape(-1, 4), flat[:count]),
                f"points arranged as {shape} have other values than the same points in one row; expected each point's"
                " value to depend on that point alone",
            ),
        )


def check_ranges(field: RadianceField) -> None:
    """Check that values are finite everywhere, density >= 0 and rgb in [0, 1]."""
    for of, positions in awkward_points().items():
        values = query(field, positions, points(len(positions), seed=1)[1], of)
        least, low, high = (float(x) for x in (values.density.min(), values.rgb.min(), values.rgb.max()))
        require(
            f"{type(field).__name__}.query of {of}",
            (values.density.isfinite().all(), "density is NaN or infinite, expected finite numbers"),
            (values.rgb.isfinite().all(), "rgb is NaN or infinite, expected finite numbers"),
            (least >= 0, f"density is {least:g}, expected 0 or more; end with softplus, relu or exp"),
            (low >= 0 and high <= 1, f"rgb is from {low:g} to {high:g}, expected 0 to 1; end with a sigmoid"),
        )


def check_precision(field: RadianceField, doubled: RadianceField) -> None:
    """Check that ``doubled``, a copy of ``field`` in float64, computes the same values in that precision."""
    positions, directions = points(64)
    expected = query(field, positions, directions, "points in float32")
    found = query(doubled, positions.double(), directions.double(), "points in float64, after .double()")
    for what in ("density", "rgb"):
        single, double = getattr(expected, what), getattr(found, what)
        after = f"after .double(): {what} is"
        require(
            f"{type(field).__name__}.query",
            (
                single.dtype == torch.float32,
                f"{what} is {single.dtype} for points in float32, expected float32",
            ),
            (
                double.dtype == torch.float64,
                f"{after} {double.dtype}, expected float64; make constants with positions.new_tensor or as buffers",
            ),
            (
                close(double.float(), single, 1e-2),
                f"{after} another than in float32, expected the same to rounding",
            ),
        )


def check_threads(field: RadianceField) -> None:
    """Check that concurrent queries return the same values as a single one."""
    parts = [points(200 + 31 * i, seed=i) for i in range(4)] * 8
    alone = [to_channels(query(field, *part, "points")) for part in parts[:4]] * 8
    with ThreadPoolExecutor(4) as pool:
        of = "points, by several threads at once"
        answers = pool.map(lambda part: to_channels(query(field, part[0], part[1], of)), parts)
        require(
            f"{type(field).__name__}.query",
            (
                all(map(close, answers, alone)),
                "concurrent threads get different values from a single one; expected query to store nothing on self",
            ),
        )


def to_channels(values: FieldValues) -> Tensor:
    """Return density and colour as four channels (*p 4)."""
    return torch.cat([values.density[..., None], values.rgb], dim=-1).detach()


def close(found: Tensor, expected: Tensor, tolerance: float = 1e-4) -> bool:
    """Return whether values are equal up to rounding, relative to the largest value of each channel."""
    if expected.numel() == 0:
        return found.shape == expected.shape
    scale = expected.abs().reshape(-1, expected.shape[-1]).amax(0).clamp(min=1e-6)
    return bool(((found - expected).abs() <= tolerance * scale).all())


# Derivatives, compared with finite differences.

COUNT = 64
AGREEING = 0.7
"""Fraction of the points at which derivatives must agree: a field may have kinks, which some steps cross."""
DETACHED = "expected one: query must not detach positions or run under no_grad"


def check_position_derivatives(field: RadianceField, dtype: torch.dtype) -> None:
    """Check the derivative with respect to position, along a random line through each point."""
    positions, directions = (x.to(dtype) for x in points(COUNT))
    along = SIDE * points(COUNT, seed=1)[1].to(dtype)
    _check_by(field, "position", lambda x: (x, directions), lambda t: positions + t * along, along)


def check_direction_derivatives(field: RadianceField, dtype: torch.dtype) -> None:
    """Check the derivative with respect to direction.

    It is taken along a random great circle through each direction, since directions are unit vectors.
    """
    positions, directions = (x.to(dtype) for x in points(COUNT))
    along = points(COUNT, seed=1)[1].to(dtype)
    along = torch.nn.functional.normalize(along - (along * directions).sum(-1, keepdim=True) * directions, dim=-1)

    def on_circle(t: float) -> Tensor:
        angle = torch.tensor(t, dtype=dtype)
        return angle.cos() * directions + angle.sin() * along

    _check_by(field, "direction", lambda x: (positions, x), on_circle, along)


def _check_by(
    field: RadianceField,
    by: str,
    arguments: Callable[[Tensor], tuple[Tensor, Tensor]],
    curve: Callable[[float], Tensor],
    speed: Float[Tensor, "n 3"],
) -> None:
    """Check the derivatives of density and colour as the argument named ``by`` moves along a curve.

    ``curve(t)`` returns a point on each curve at the parameter ``t``, and ``speed`` is its derivative at 0. The exact
    derivatives, from reverse mode, must agree with finite differences at the best step size.
    """

    def values(varied: Tensor) -> Float[Tensor, "n 4"]:
        found = query(field, *arguments(varied), f"points with {by}s that require gradients")
        return torch.cat([found.density[..., None], found.rgb], dim=-1)

    leaf = curve(0.0).detach().requires_grad_()
    start = values(leaf)
    exact = torch.zeros_like(start)
    for c in range(start.shape[1] if start.requires_grad else 0):
        with calling("backward through query"):
            (gradient,) = torch.autograd.grad(start[:, c].sum(), leaf, retain_graph=True, allow_unused=True)
        if gradient is not None:
            exact[:, c] = (gradient * speed).sum(-1)
    exact = exact.detach()
    is_precise = speed.dtype == torch.float64
    steps, tolerance = ([1e-3, 1e-4, 1e-5, 1e-6], 1e-3) if is_precise else ([3e-2, 1e-2, 3e-3], 0.05)
    with torch.no_grad():
        measured = torch.stack([(values(curve(h)) - values(curve(-h))) / (2 * h) for h in steps])
    error = (measured - exact).abs().amin(0)
    allowed = tolerance * torch.maximum(exact.abs(), measured.abs().median(0).values)
    for what, channels in (("density", slice(0, 1)), ("rgb", slice(1, 4))):
        size = start[:, channels].detach().abs().amax()
        agreeing = error[:, channels] <= allowed[:, channels] + 1e-3 * tolerance * size
        share = float(agreeing.to(speed.dtype).mean())
        require(
            f"{type(field).__name__}.query",
            (
                share >= AGREEING,
                f"the derivative of {what} by {by} agrees with finite differences at {share:.0%} of the points,"
                f" expected {AGREEING:.0%}; is something detached, rounded or clamped?",
            ),
        )


def check_jacobian(field: RadianceField, dtype: torch.dtype) -> None:
    """Check that a field's ``jacobian``, if it has one, returns the values of ``query`` and their derivatives."""
    if not isinstance(field, DifferentiatedField):
        return
    positions, directions = (x.to(dtype) for x in points(COUNT))
    who = f"{type(field).__name__}.jacobian"
    with calling(who):
        found = field.jacobian(positions, directions)
    expected = backward_derivatives(field.query, positions, directions)
    # Directions are unit vectors.
    across = torch.eye(3, dtype=dtype) - directions[:, :, None] * directions[:, None]
    for what, ours, theirs in (
        ("density", found.values.density, expected.values.density),
        ("rgb", found.values.rgb, expected.values.rgb),
        ("the derivative by position", found.by_position, expected.by_position),
        ("the derivative by direction", found.by_direction @ across, expected.by_direction @ across),
    ):
        require(
            who,
            (
                ours.shape == theirs.shape and float((ours - theirs).norm()) <= 1e-3 * float(theirs.norm()) + 1e-9,
                f"{what} differs from that of query",
            ),
        )


def check_pose_gradient(field: RadianceField, dtype: torch.dtype) -> None:
    """Check that rendered colour and distance have a gradient with respect to the camera's pose."""
    delta = torch.zeros(6, dtype=dtype, requires_grad=True)
    nudge = torch.tensor([0.02, -0.03, 0.01, 0.02, 0.01, -0.02], dtype=dtype)
    T_world_camera = rgbd_views()[0].T_ref_camera.to(dtype=dtype).retract(nudge).retract(delta)
    who = f"{type(field).__name__} rendered from a pose"
    with calling(who):
        rendering = render(field, camera_rays(T_world_camera))
    for what, value in (("rgb", rendering.rgb.square().mean()), ("distance", rendering.distance.mean())):
        require(who, (value.requires_grad, f"{what} carries no gradient; {DETACHED}"))
        (gradient,) = torch.autograd.grad(value, delta, retain_graph=True)
        require(
            who,
            (gradient.isfinite().all(), f"the gradient of {what} is NaN or infinite"),
            (gradient.abs().max() > 0, f"the gradient of {what} is zero; {DETACHED}"),
        )


# Samples and renderings.

SLACK = 1e-4 * SIDE  # metres: rounding error allowed in a distance
BACKGROUND = (0.1, 0.5, 0.9)


def check_intervals(field: RadianceField) -> None:
    """Check that valid samples are sorted, disjoint and in [near, far].

    Rays that miss the scene must have no valid samples, and batches without rays must be accepted.
    """
    for of, rays in awkward_rays().items():
        for jitter, how in ((None, ""), (generator(), " with jitter")):
            samples = sample(field, rays, of + how, jitter)
            starts, ends, valid = samples.starts, samples.ends, samples.valid
            reached = torch.where(valid, ends, -torch.inf).cummax(-1).values if starts.shape[-1] else ends
            overlap = (starts[..., 1:] < reached[..., :-1] - SLACK) & valid[..., 1:]
            within = (starts >= rays.near[..., None] - SLACK) & (ends <= rays.far[..., None] + SLACK)
            require(
                f"sampler {type(field.sampler).__name__} of {of}{how}",
                (
                    (starts.isfinite() & ends.isfinite()).all(),
                    "starts or ends are NaN or infinite; expected finite numbers, also where not valid",
                ),
                (
                    (starts <= ends + SLACK)[valid].all(),
                    "an interval ends before it starts, or is not sorted",
                ),
                (
                    not overlap.any(),
                    "valid intervals overlap or are not sorted, expected nearest first",
                ),
                (within[valid].all(), "a valid interval lies outside [near, far] of its ray"),
                (
                    not valid[rays.far <= rays.near].any(),
                    "a ray with far <= near has valid samples, expected none",
                ),
            )
    for arranged in _arrangements():
        sample(field, arranged, f"rays arranged as {tuple(arranged.near.shape)}")


def _arrangements() -> Iterator[Rays]:
    """Yield batches of rays with various shapes, some of them without any rays."""
    for shape in ((), (1,), (2, 3), (0,), (2, 0)):
        yield awkward_rays()["rays from outside"][torch.arange(torch.Size(shape).numel()).reshape(shape)]


def check_repeatable(field: RadianceField) -> None:
    """Check that samples are reproducible without jitter and, with jitter, for equal seeds of the given generator."""
    rays = Rays.joined(awkward_rays().values())
    with torch.random.fork_rng(devices=[]):
        twice = [sample(field, rays, "rays") for _ in range(2)]
        jittered = [sample(field, rays, "rays with jitter", generator()) for _ in range(2)]

    def same(a: RaySamples, b: RaySamples) -> bool:
        return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("starts", "ends", "valid"))

    require(
        f"sampler {type(field.sampler).__name__}",
        (same(*twice), "two calls without jitter differ, expected no randomness without a generator"),
        (
            same(*jittered),
            "two calls with jitter of the same seed differ, expected all randomness to come from the given generator",
        ),
    )


def check_rays_alone(field: RadianceField) -> None:
    """Check that the rendering of a ray depends neither on the other rays nor on their arrangement."""
    rays = Rays.joined(awkward_rays().values())
    count = len(rays.near) // 4 * 4
    whole = render_channels(field, rays[:count], "rays")
    order = torch.randperm(count, generator=generator())
    permuted = render_channels(field, rays[order.reshape(4, -1)], "rays in another order").reshape(-1, 5)
    alone = torch.cat([render_channels(field, rays[i : i + 1], "a ray") for i in range(0, count, 7)])
    expected = "expected each ray to be sampled for itself"
    require(
        f"{type(field).__name__} rendered",
        (close(permuted, whole[order], 1e-3), f"rays in another order see something else; {expected}"),
        (
            close(alone, whole[::7], 1e-3),
            f"a ray alone sees something different from when among others; {expected}",
        ),
    )


def check_background(field: RadianceField) -> None:
    """Check that a ray that misses the scene sees only the background."""
    found = render_channels(field, awkward_rays()["rays that miss the scene"], "rays that miss the scene")
    require(
        f"{type(field).__name__} rendered",
        (
            close(found, torch.tensor([*BACKGROUND, 0.0, 0.0]).expand_as(found)),
            "a ray with far <= near does not see the background alone; is a sample valid there?",
        ),
    )


def check_levels(field: RadianceField) -> None:
    """Check that each level is a field, and that the last level renders like the field itself."""
    offered = tuple(getattr(field, "levels", None) or (field,))
    expected = "expected a field: an object with sampler and query"
    require(
        type(field).__name__,
        *(
            (isinstance(level, RadianceField), f"levels[{number}] is a {type(level).__name__}, {expected}")
            for number, level in enumerate(offered)
        ),
    )
    rays = Rays.joined(awkward_rays().values())
    require(
        f"{type(field).__name__}.levels",
        (
            close(render_channels(offered[-1], rays, "rays"), render_channels(field, rays, "rays"), 1e-3),
            "the last one renders otherwise than the field itself; expected the coarsest first and the field itself last",
        ),
    )


def check_hits(field: RadianceField) -> None:
    """Check the hits of a field that provides them.

    Values must be in range and distances in [near, far]; the opacity must match that of the field's density.
    """
    if not isinstance(field, HitField):
        return

    def hits(rays: Rays, of: str) -> RayHits:
        with calling(f"{type(field).__name__}.hits of {of}"), torch.no_grad():
            return field.hits(rays)

    for of, rays in awkward_rays().items():
        found = hits(rays, of)
        distance, alpha, rgb, valid = found.distance, found.alpha, found.rgb, found.valid
        within = (distance >= rays.near[..., None] - SLACK) & (distance <= rays.far[..., None] + SLACK)
        named = (("distance", distance), ("alpha", alpha), ("rgb", rgb))
        require(
            f"{type(field).__name__}.hits of {of}",
            *((x.isfinite().all(), f"{what} is NaN or infinite, also where not valid") for what, x in named),
            *((((x >= 0) & (x <= 1)).all(), f"{what} is outside of [0, 1], expected within") for what, x in named[1:]),
            (not (alpha[~valid] != 0).any(), "alpha is not 0 where a hit is not valid"),
            (within[valid].all(), "a valid hit lies outside [near, far] of its ray"),
        )
    for arranged in _arrangements():
        of, shape = f"rays arranged as {tuple(arranged.near.shape)}", tuple(arranged.near.shape)
        given = tuple(hits(arranged, of).distance.shape)
        require(
            f"{type(field).__name__}.hits of {of}",
            (
                given[:-1] == shape,
                f"distance has shape {given}, expected the rays' shape and one more axis",
            ),
        )
    # The density of ``query``, integrated along rays, must absorb as much light as the hits do.
    rays = awkward_rays()["rays from outside"]
    expected = 1 - torch.prod(1 - hits(rays, "rays").alpha, dim=-1)
    samples = Stratified(1024)(rays)
    with calling(f"{type(field).__name__}.query along rays"), torch.no_grad():
        places = rays.at(samples.middles)
        density = field.query(places, rays.directions[..., None, :].expand_as(places)).density
    absorbed = rendering_weights(density, samples).sum(-1)
    off = (absorbed - expected).abs()
    require(
        type(field).__name__,
        (
            float((off <= 0.05).float().mean()) >= 0.9,  # of nine rays out of ten
            f"query's density stops {float(absorbed.mean()):.0%} of the light of rays on average and hits stop"
            f" {float(expected.mean()):.0%}, up to {float(off.max()):.0%} apart; expected the integral of the density along"
            " a ray to give the opacity of its hits",
        ),
    )


def render_channels(field: RadianceField, rays: Rays, of: str) -> Tensor:
    """Return rendered colour, distance and opacity as five channels (*r 5)."""
    with calling(f"render of {of} by {type(field).__name__}"), torch.no_grad():
        rendering = render(field, rays, BACKGROUND)
    channels = [rendering.rgb, rendering.distance[..., None], rendering.opacity[..., None]]
    return torch.cat(channels, dim=-1)
