"""Checks of a field's derivatives against finite differences."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.fields import DifferentiatedField, RadianceField, backward_derivatives, render
from bidnerf_core.geometry import SE3
from bidnerf_core.testing.faults import calling, query, require_that
from bidnerf_core.testing.scene import SIDE, camera_rays, points, rgbd_views

COUNT = 64
AGREEING = 0.7
"""Fraction of the points at which derivatives must agree: a field may have kinks, which some steps cross."""

Asked = Callable[[Tensor], Tensor]
"""A function from points (n 3) to values (n c)."""


def check_position_derivatives(field: RadianceField, dtype: torch.dtype) -> None:
    """Check the derivative with respect to position, along a random line through each point."""
    positions, directions = (x.to(dtype) for x in points(COUNT))
    along = SIDE * points(COUNT, seed=1)[1].to(dtype)
    _check_by(field, "position", lambda x: (x, directions), lambda t: positions + t * along, along)


def check_direction_derivatives(field: RadianceField, dtype: torch.dtype) -> None:
    """Check the derivative with respect to direction.

    It is that along a random great circle through each direction, since directions are unit vectors.
    """
    positions, directions = (x.to(dtype) for x in points(COUNT))
    along = points(COUNT, seed=1)[1].to(dtype)
    along = torch.nn.functional.normalize(
        along - (along * directions).sum(-1, keepdim=True) * directions, dim=-1
    )

    def on_circle(t: float) -> Tensor:
        angle = torch.tensor(t, dtype=dtype)
        return angle.cos() * directions + angle.sin() * along

    _check_by(field, "direction", lambda x: (positions, x), on_circle, along)


def check_jacobian(field: RadianceField, dtype: torch.dtype) -> None:
    """Check that the ``jacobian`` of a field that offers one has the values of ``query`` and their derivatives."""
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
        same = (
            ours.shape == theirs.shape and float((ours - theirs).norm()) <= 1e-3 * float(theirs.norm()) + 1e-9
        )
        require_that(same, f"{who}: {what} differs from that of query")


def _check_by(
    field: RadianceField, by: str, arguments: Callable[[Tensor], tuple[Tensor, Tensor]], curve: Callable[[float], Tensor],
    speed: Float[Tensor, "n 3"],
) -> None:  # fmt: skip
    """Check the derivatives of density and colour along a curve of the argument named ``by``."""
    for what in ("density", "rgb"):

        def ask(varied: Tensor, what: str = what) -> Tensor:
            values = query(field, *arguments(varied), f"points with {by}s that require gradients")
            return getattr(values, what).reshape(COUNT, -1)

        share = float(agreement(ask, curve, speed, speed.dtype))
        require_that(
            share >= AGREEING,
            f"{type(field).__name__}.query: the derivative of {what} by {by} agrees with finite differences at"
            f" {share:.0%} of the points, expected {AGREEING:.0%}; is something detached, rounded or clamped?",
        )


def check_pose_gradient(field: RadianceField, dtype: torch.dtype) -> None:
    """Check that rendered colour and distance have a gradient with respect to the camera's pose."""
    delta = torch.zeros(6, dtype=dtype, requires_grad=True)
    start = rgbd_views()[0].T_ref_camera.to(dtype=dtype)
    nudge = torch.tensor([0.02, -0.03, 0.01, 0.02, 0.01, -0.02], dtype=dtype)
    T_world_camera: SE3 = start.retract(nudge).retract(delta)
    who = f"{type(field).__name__} rendered from a pose"
    with calling(who):
        rendering = render(field, camera_rays(T_world_camera))
        seen = {"rgb": rendering.rgb.square().mean(), "distance": rendering.distance.mean()}
    for what, value in seen.items():
        require_that(value.requires_grad, f"{who}: {what} carries no gradient; {DETACHED}")
        (gradient,) = torch.autograd.grad(value, delta, retain_graph=True)
        require_that(bool(gradient.isfinite().all()), f"{who}: the gradient of {what} is NaN or infinite")
        require_that(bool(gradient.abs().max() > 0), f"{who}: the gradient of {what} is zero; {DETACHED}")


DETACHED = "expected one: query must not detach positions or run under no_grad"


def agreement(
    ask: Asked, moved: Callable[[float], Tensor], speed: Float[Tensor, "n 3"], dtype: torch.dtype
) -> Float[Tensor, ""]:
    """Return the fraction of values whose derivative along a curve agrees with finite differences at the best step size.

    ``moved(t)`` are the points at ``t`` on their curves, ``speed`` (n 3) is its derivative at 0.
    """
    exact = _slopes(ask, moved(0.0), speed)
    steps, tolerance = (
        ((1e-3, 1e-4, 1e-5, 1e-6), 1e-3) if dtype == torch.float64 else ((3e-2, 1e-2, 3e-3), 0.05)
    )
    with torch.no_grad():
        measured = torch.stack([(ask(moved(h)) - ask(moved(-h))) / (2 * h) for h in steps])
        size = ask(moved(0.0)).abs().amax()
    error = (measured - exact).abs().amin(0)
    allowed = tolerance * torch.maximum(exact.abs(), measured.abs().median(0).values)
    return (error <= allowed + 1e-3 * tolerance * size).to(dtype).mean()


def _slopes(ask: Asked, at: Float[Tensor, "n 3"], speed: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """Return the derivative of each channel along ``speed``, in reverse mode; 0 if it does not depend on the argument."""
    leaf = at.detach().requires_grad_()
    values = ask(leaf)
    slopes = torch.zeros_like(values)
    if not values.requires_grad:
        return slopes
    for c in range(values.shape[1]):
        with calling("backward through query"):
            (gradient,) = torch.autograd.grad(values[:, c].sum(), leaf, retain_graph=True, allow_unused=True)
        if gradient is not None:
            slopes[:, c] = (gradient * speed).sum(-1)
    return slopes.detach()
