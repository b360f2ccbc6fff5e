"""The contract between the core and any radiance field.

Shapes: *r rays, *p points, s samples on a ray. Units: metres (or scene units) in the world frame; density per
metre. Directions are always unit vectors, so distance along the ray is the only length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from bidnerf_core.devices import TensorRows, constant
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import scale_point
from bidnerf_core.settings import LARGEST_LENGTH


def contract_points(points: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
    """Return ``x`` where its norm is at most 1, and ``(2 - 1 / |x|) x / |x|`` elsewhere (eq. 10); every norm is below 2."""
    norm = points.abs().amax(-1, keepdim=True).clamp(min=1)
    return points * ((2 - 1 / norm) / norm)


@dataclass(frozen=True, eq=False)
class RaySpacing:
    """A coordinate along rays in which equal steps match the resolution of a contracted field (eq. 11).

    The coordinate is the distance (metres) up to ``exit``, where the ray leaves the uncontracted box, and ``exit + radius
    * x / (1 + x)`` beyond, with ``x`` the distance from ``exit`` in units of ``radius``.
    """

    exit: Float[Tensor, "*r"]  # metres along the ray
    radius: float  # metres: half the side of the uncontracted cube; infinite without contraction

    def coordinate(self, distance: Float[Tensor, "*r s"]) -> Float[Tensor, "*r s"]:
        """Convert distances along the rays (metres) to the coordinate."""
        if self.radius == float("inf"):
            return distance
        beyond = (distance - self.exit[..., None]).clamp(min=0)
        return torch.minimum(distance, self.exit[..., None]) + beyond / (1 + beyond / self.radius)

    def distance(self, coordinate: Float[Tensor, "*r s"]) -> Float[Tensor, "*r s"]:
        """Convert the coordinate to distances along the rays (metres), the inverse of ``coordinate``."""
        if self.radius == float("inf"):
            return coordinate
        beyond = (coordinate - self.exit[..., None]).clamp(min=0)
        left = (1 - beyond / self.radius).clamp(min=torch.finfo(coordinate.dtype).eps)
        return torch.minimum(coordinate, self.exit[..., None]) + beyond / left


@dataclass(frozen=True, eq=False)
class Rays(TensorRows):
    """Half-lines, each with the interval [near, far] that may contain matter. ``far <= near`` marks a ray that misses the scene."""

    origins: Float[Tensor, "*r 3"]
    directions: Float[Tensor, "*r 3"]  # unit
    near: Float[Tensor, "*r"]  # distance along the ray, not z
    far: Float[Tensor, "*r"]

    def at(self, distance: Float[Tensor, "*r s"]) -> Float[Tensor, "*r s 3"]:
        return self.origins[..., None, :] + distance[..., None] * self.directions[..., None, :]

    def flattened(self) -> Rays:
        """Return the rays flattened to one axis."""
        points = self.origins.reshape(-1, 3), self.directions.reshape(-1, 3)
        return Rays(*points, self.near.reshape(-1), self.far.reshape(-1))


@dataclass(frozen=True, eq=False)
class RaySamples:
    """Disjoint intervals along each ray, nearest first; the field is queried at their midpoints. Invalid intervals have no effect."""

    starts: Float[Tensor, "*r s"]
    ends: Float[Tensor, "*r s"]
    valid: Bool[Tensor, "*r s"]

    @property
    def middles(self) -> Float[Tensor, "*r s"]:
        return (self.starts + self.ends) / 2

    @property
    def parts(self) -> tuple[Tensor, Tensor, Tensor]:
        """The start, the end and the validity of each interval."""
        return self.starts, self.ends, self.valid

    def unflattened(self, shape: torch.Size) -> RaySamples:
        """Restore the original ``shape`` of rays that were flattened."""
        return RaySamples(*(part.reshape(*shape, part.shape[-1]) for part in self.parts))


@dataclass(frozen=True, eq=False)
class FieldValues:
    """Density at points, and colour seen along a viewing direction at each."""

    density: Float[Tensor, "*p"]  # >= 0, per metre
    rgb: Float[Tensor, "*p 3"]  # in [0, 1]


@dataclass(frozen=True, eq=False)
class FieldDerivatives:
    """A field's values at points, with the derivatives of the density and the three colour channels, in this order."""

    values: FieldValues
    by_position: Float[Tensor, "*p 4 3"]  # per metre
    by_direction: Float[Tensor, "*p 4 3"]  # in all three coordinates, as if directions need not be unit vectors


@runtime_checkable
class RaySampler(Protocol):
    """Chooses where on each ray a field is queried. Deterministic without ``jitter``."""

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples: ...


@runtime_checkable
class RadianceField(Protocol):
    """A scene as differentiable density and colour. Only reverse-mode derivatives are required."""

    @property
    def sampler(self) -> RaySampler: ...

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return density and colour at ``positions`` (metres, world; possibly none) seen along unit ``directions``."""
        ...


@runtime_checkable
class DifferentiatedField(RadianceField, Protocol):
    """Optional interface of a field that computes derivatives along with its values, faster than a backward pass would.

    To get the derivatives of any field, call ``derivatives_of``.
    """

    def jacobian(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"], wanted: Bool[Tensor, "p"] | None = None
    ) -> FieldDerivatives:
        """Return the values of ``query`` and their derivatives, without recording gradients.

        Points that are not ``wanted`` may be skipped: the numbers returned for them are not used, but must be finite.
        """
        ...


@dataclass(frozen=True, eq=False)
class RayHits:
    """Hits along rays: their distances, colours and opacities, in compositing order.

    Compositing order is the order of distance, except for fields that composite otherwise, such as splats trained in the
    order of their means. Invalid hits have no effect.
    """

    distance: Float[Tensor, "*r s"]  # metres along the ray
    alpha: Float[Tensor, "*r s"]  # fraction of the light stopped there, in [0, 1]; 0 where not valid
    rgb: Float[Tensor, "*r s 3"]  # in [0, 1]
    valid: Bool[Tensor, "*r s"]

    @property
    def samples(self) -> RaySamples:
        """The hits as intervals of zero length."""
        return RaySamples(self.distance, self.distance, self.valid)


@runtime_checkable
class HitField(RadianceField, Protocol):
    """Optional interface of a field that computes all hits of a ray at once, as splats and meshes do.

    ``render`` then uses ``hits`` instead of ``sampler`` and ``query``. ``sampler`` and ``query`` remain available for points
    and for other ways of sampling rays, and are consistent with ``hits``: the integral of ``query``'s density along a ray
    gives the opacity of the ray's hits.
    """

    def hits(self, rays: Rays) -> RayHits:
        """Return the hits of rays in [near, far]; differentiable in the rays and in the parameters."""
        ...


@dataclass(frozen=True, eq=False)
class Splats:
    """The primitives of a field (splats, triangles, discs) as points, for drawing without ray casting."""

    positions: Float[Tensor, "n 3"]  # metres, world
    rgb: Float[Tensor, "n 3"]  # in [0, 1], independent of direction
    opacity: Float[Tensor, "n"]  # in [0, 1]
    radius: Float[Tensor, "n"]  # metres: the geometric mean of the standard deviations along its axes


@runtime_checkable
class SplatField(Protocol):
    """Optional interface of fields made of discrete primitives (splats, triangles, discs), which viewers can draw."""

    def splats(self) -> Splats:
        """Return all primitives, in any order."""
        ...


def levels(field: RadianceField) -> tuple[RadianceField, ...]:
    """Return the field's levels of detail, coarsest first; a field without levels is returned as the only one."""
    return tuple(getattr(field, "levels", None) or (field,))


def derivatives_of(
    field: RadianceField,
    positions: Float[Tensor, "p 3"],
    directions: Float[Tensor, "p 3"],
    wanted: Bool[Tensor, "p"] | None = None,
) -> FieldDerivatives:
    """Return a field's values and their derivatives at the ``wanted`` points, using the field's ``jacobian`` if it has one."""
    if isinstance(field, DifferentiatedField):
        return field.jacobian(positions, directions, wanted)
    return backward_derivatives(field.query, positions, directions)


def backward_derivatives(
    query: Callable[[Tensor, Tensor], FieldValues], positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
) -> FieldDerivatives:
    """Return the values of ``query`` at points and their derivatives, by one backward pass per channel.

    Points are independent, so the gradient of a channel's sum contains the gradients of all points. On an accelerator, where
    launches take most of the time, a single pass over four copies of up to 65536 points replaces the four passes.
    """
    n = len(positions)
    copies = 4 if positions.device.type != "cpu" and n <= 2**16 else 1
    with torch.enable_grad():
        leaves = [part.detach().repeat(copies, 1).requires_grad_() for part in (positions, directions)]
        output = query(*leaves)
        channels = [output.density, *output.rgb.unbind(-1)]
        if copies > 1:
            channels = [torch.cat([part[k * n : (k + 1) * n] for k, part in enumerate(channels)])]
        gradients = [
            torch.autograd.grad(channel.sum(), leaves, retain_graph=True, materialize_grads=True)
            if channel.requires_grad
            else [torch.zeros_like(leaf) for leaf in leaves]
            for channel in channels
        ]
    by_position, by_direction = (
        torch.cat([part.unflatten(0, (copies, n)) for part in parts]).movedim(0, 1)
        for parts in zip(*gradients, strict=True)
    )
    values = FieldValues(output.density.detach()[:n], output.rgb.detach()[:n])
    return FieldDerivatives(values, by_position, by_direction)


def device_of(field: RadianceField) -> torch.device:
    """Return the device of a field's parameters or buffers, or of the first field that a dataclass wraps; else the CPU."""
    tensor = next((first for kind in ("parameters", "buffers") for first in _tensors_of(field, kind)), None)
    return torch.device("cpu") if tensor is None else tensor.device


def is_frozen(field: RadianceField) -> bool:
    """Return whether none of the parameters of a field, or of the first field that a dataclass wraps, is being trained."""
    return not any(part.requires_grad for part in _tensors_of(field, "parameters"))


def _tensors_of(field: object, kind: str) -> Iterator[Tensor]:
    """Yield the parameters or the buffers of a module, or of the first field that a dataclass wraps."""
    if (listed := getattr(field, kind, None)) is not None:
        yield from listed()
    elif is_dataclass(field):
        inner = (getattr(field, part.name) for part in fields(field))
        yield from _tensors_of(next((part for part in inner if isinstance(part, RadianceField)), None), kind)


@dataclass(frozen=True)
class SceneBounds:
    """Extent, depth range and background of a scene, known before training; stored as plain numbers in JSON."""

    lower: tuple[float, float, float]  # metres, world: corners of the box that holds all matter
    upper: tuple[float, float, float]
    near: float  # metres along a ray: nothing of interest is nearer ...
    far: float  # ... or farther
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # colour seen where a ray hits nothing
    # Whether there is matter beyond the box, up to ``far``: fields contract what lies outside the box's cube.
    contracted: bool = False
    # Metres: width covered by a pixel at the usual distance, which determines how fine a field must be; 0:
    # unknown.
    footprint: float = 0.0

    def __post_init__(self) -> None:
        largest = max(map(abs, (*self.lower, *self.upper, self.far, self.footprint)))
        checks = (
            (
                all(low < high for low, high in zip(self.lower, self.upper, strict=True)),
                f"lower corner {self.lower} is not below upper corner {self.upper}",
                None,
            ),
            (0 <= self.near < self.far, f"expected 0 <= near < far, got near {self.near}, far {self.far}", None),
            (self.footprint >= 0, f"footprint is {self.footprint}", "0 or more"),
            (
                all(0 <= channel <= 1 for channel in self.background),
                f"background is {self.background}",
                "three numbers in [0, 1]",
            ),
            (largest <= LARGEST_LENGTH, f"{largest:g} m is too large", f"at most {LARGEST_LENGTH:g} m"),
        )
        for holds, fault, expected in checks:
            if not holds:
                raise InputError(fault, where="scene bounds", expected=expected)

    @property
    def size(self) -> tuple[float, float, float]:
        a, b = self.lower, self.upper
        return (b[0] - a[0], b[1] - a[1], b[2] - a[2])

    @property
    def centre(self) -> tuple[float, float, float]:
        a, b = self.lower, self.upper
        return ((a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2)

    @property
    def side(self) -> float:
        """Side of the cube around the box (metres)."""
        return max(self.size)

    def scaled(self, factor: float) -> SceneBounds:
        """Return the bounds of the scene with lengths multiplied by ``factor``."""
        return replace(
            self,
            lower=scale_point(self.lower, factor),
            upper=scale_point(self.upper, factor),
            near=self.near * factor,
            far=self.far * factor,
            footprint=self.footprint * factor,
        )

    def normalized(self, positions: Float[Tensor, "*p 3"]) -> Float[Tensor, "*p 3"]:
        """Return positions (metres, world) scaled so that the modelled space is the cube [-1, 1].

        The modelled space is the cube around the box or, if the scene is contracted, all of space: the cube around
        the box then fills the inner half of each axis.
        """
        scaled = (positions - constant(self.centre, positions)) * (2 / self.side)
        return contract_points(scaled) / 2 if self.contracted else scaled

    def rays(self, origins: Float[Tensor, "*r 3"], directions: Float[Tensor, "*r 3"]) -> Rays:
        """Return the rays limited to [near, far] and, unless the scene is contracted, to the box (slab method).

        The limits carry no gradient.
        """
        with torch.no_grad():
            if self.contracted:
                near = torch.full_like(origins[..., 0], self.near)
                return Rays(origins, directions, near, torch.full_like(near, self.far))
            enter, leave = intersect_box(
                origins, directions, constant(self.lower, origins), constant(self.upper, origins)
            )
            near = enter.clamp(self.near, self.far)
            far = leave.clamp(max=self.far)
        return Rays(origins, directions, near, torch.maximum(near, far))

    @torch.no_grad()
    def spacing(self, rays: Rays) -> RaySpacing:
        """Return the coordinate along the rays in which a field with these bounds should be sampled at equal steps."""
        origins, directions = rays.origins.detach(), rays.directions.detach()
        if not self.contracted:
            return RaySpacing(torch.zeros_like(rays.near), float("inf"))
        half = self.side / 2
        lower, upper = (tuple(c + sign * half for c in self.centre) for sign in (-1, 1))
        enter, leave = intersect_box(origins, directions, constant(lower, origins), constant(upper, origins))
        return RaySpacing(torch.where(leave > enter, leave, 0).clamp(min=0), half)


def intersect_box(
    origins: Float[Tensor, "*r 3"],
    directions: Float[Tensor, "*r 3"],
    lower: Float[Tensor, "3"],
    upper: Float[Tensor, "3"],
) -> tuple[Float[Tensor, "*r"], Float[Tensor, "*r"]]:
    """Return the distances (metres) at which lines enter and leave a box (slab method); entry > exit means a miss."""
    tiny = torch.full_like(directions, torch.finfo(directions.dtype).tiny)
    slope = 1 / torch.where(directions.abs() < tiny, tiny, directions)
    first, second = (lower - origins) * slope, (upper - origins) * slope
    return torch.minimum(first, second).amax(-1), torch.maximum(first, second).amin(-1)


def widen(rays: Rays, factor: float) -> Rays:
    """Return rays whose interval is ``factor`` times as long (the paper's "wide"), but does not begin behind the camera."""
    middle, half = (rays.near + rays.far) / 2, (rays.far - rays.near) / 2 * factor
    return replace(rays, near=(middle - half).clamp(min=0), far=middle + half)
