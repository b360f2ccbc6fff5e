"""Solids with closed-form ray intersections.

Every shape is convex and centred on the origin of its own frame, so a line meets it in one interval. Rays are
arrays of shape (3 n), with x, y and z each contiguous: for the few operations here, that layout is several
times as fast as (n 3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.scenes.textures import Texture, dominant_axis


@dataclass(frozen=True)
class Sphere:
    """A ball."""

    radius: float

    @property
    def reach(self) -> float:
        return self.radius

    def interval(
        self, origins: Float[Tensor, "3 #n"], directions: Float[Tensor, "3 n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        middle = -(origins * directions).sum(0)
        nearest = origins + middle * directions  # its length suffers no cancellation, unlike |o|^2 - (o.d)^2
        return _chord(middle, self.radius**2 - (nearest * nearest).sum(0))

    def normals(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        return torch.nn.functional.normalize(points, dim=-1)


@dataclass(frozen=True)
class Box:
    """A cuboid with its corners at plus and minus ``half`` (metres)."""

    half: tuple[float, float, float]

    @property
    def reach(self) -> float:
        return sum(h * h for h in self.half) ** 0.5

    def interval(
        self, origins: Float[Tensor, "3 #n"], directions: Float[Tensor, "3 n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        slope = 1 / _tilted(directions)
        middle, reach = -origins * slope, slope.abs() * directions.new_tensor(self.half)[:, None]
        enter, leave = middle - reach, middle + reach
        return (
            torch.maximum(torch.maximum(enter[0], enter[1]), enter[2]),
            torch.minimum(torch.minimum(leave[0], leave[1]), leave[2]),
        )

    def normals(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        relative = points / points.new_tensor(self.half)
        return relative.sign() * dominant_axis(relative)


@dataclass(frozen=True)
class Cylinder:
    """A cylinder around the z axis, from minus to plus ``half`` (metres); a flat one is a disc."""

    radius: float
    half: float

    @property
    def reach(self) -> float:
        return (self.radius**2 + self.half**2) ** 0.5

    def interval(
        self, origins: Float[Tensor, "3 #n"], directions: Float[Tensor, "3 n"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"]]:
        (ox, oy, oz), (dx, dy, dz) = origins, _tilted(directions)
        across = dx * dx + dy * dy
        offset = (ox * dy - oy * dx) ** 2 / across  # squared distance of the line from the axis
        middle = -(ox * dx + oy * dy) / across
        enter, leave = _chord(middle, (self.radius**2 - offset) / across)
        cap, reach = -oz / dz, self.half / dz.abs()
        return torch.maximum(enter, cap - reach), torch.minimum(leave, cap + reach)

    def normals(self, points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        flat = points * points.new_tensor([1.0, 1.0, 0.0])
        up = points * points.new_tensor([0.0, 0.0, 1.0])
        across = torch.linalg.vector_norm(flat, dim=-1, keepdim=True)
        on_cap = up.abs().amax(-1, keepdim=True) / self.half > across / self.radius
        return torch.nn.functional.normalize(torch.where(on_cap, up, flat), dim=-1)


Shape: TypeAlias = Sphere | Box | Cylinder
"""A convex solid around the origin of its own frame (metres): ``reach``, the radius of a ball that contains it; ``interval``, where
lines enter and leave it, along their directions, possibly negative (leave < enter means a miss); and the outward unit ``normals`` at
points of its surface.
"""


@dataclass(frozen=True, eq=False)
class Primitive:
    """A shape with its pose and its texture."""

    shape: Shape
    T_world_shape: SE3
    texture: Texture

    def distance(
        self, origins: Float[Tensor, "3 #n"], directions: Float[Tensor, "3 n"]
    ) -> Float[Tensor, " n"]:
        """Return the distance to the first crossing in front of the origin (metres; world, unit directions); inf: none.

        From inside a solid, this is where the ray leaves it: a box seen from inside is a room.
        """
        T = self.T_world_shape.to(directions)
        turned = T.rotation.mT @ directions
        enter, leave = self.shape.interval(T.rotation.mT @ (origins - T.translation[:, None]), turned)
        first = torch.where(enter > 0, enter, leave)
        return torch.where((leave >= enter) & (leave > 0), first, torch.inf)

    def surface(self, points: Float[Tensor, "3 n"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Return the unlit colour (in [0, 1]) and the outward normal (world) at points of the surface (world)."""
        T = self.T_world_shape.to(points)
        local = (T.rotation.mT @ (points - T.translation[:, None])).T
        normals = self.shape.normals(local)
        return self.texture(local, normals), normals @ T.rotation.mT


def _chord(middle: Tensor, squared: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``middle`` -+ sqrt(squared); where ``squared`` is negative, an empty interval whose end is before its start."""
    half = squared.clamp(min=0).sqrt()
    half = torch.where(squared < 0, -torch.inf, half)
    return middle - half, middle + half


def _tilted(directions: Tensor) -> Tensor:
    """Return directions whose components are not so near 0 that divisions overflow; the change of the ray is negligible."""
    return torch.where(directions.abs() < 1e-12, 1e-12, directions)
