"""Measured points on a baked surface: the cost of poses, and its exact derivatives, for many poses at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.localization.solvers.levenberg_marquardt import System
from bidnerf_core.localization.solvers.pivots import Pivot
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.se3 import SE3, skew

BESIDE = 1.5
"""How far along its plane a surfel reaches, in cells of the map."""
STEEPEST = 0.2
"""How much a surfel's colour may change along its plane before it is no longer believed."""


@dataclass(frozen=True)
class Scales:
    """From where on a measurement counts for little (Geman and McClure 1985), and what colour counts beside distance."""

    distance: float  # metres
    colour: float = 0.15  # of all channels together, each in [0, 1]
    colour_weight: float = 1.0


@dataclass(frozen=True, eq=False)
class Cloud:
    """Measured points with their colours, in the frame of the camera that is sought."""

    points: Float[Tensor, "p 3"]  # metres
    rgb: Float[Tensor, "p 3"]
    origins: Float[Tensor, "p 3"]  # metres: where each was seen from

    def __len__(self) -> int:
        return len(self.points)

    def first(self, count: int) -> Cloud:
        return Cloud(*(part[:count] for part in (self.points, self.rgb, self.origins)))

    @cached_property
    def middle(self) -> Float[Tensor, "3"]:
        return self.points.median(0).values

    @cached_property
    def basis(self) -> Float[Tensor, "p 3 6"]:
        """Derivative of the points, in the camera's axes, by an update about their middle."""
        turned = -skew(self.points - self.middle)
        return torch.cat([torch.eye(3).to(turned).expand_as(turned), turned], dim=-1)

    @cached_property
    def squares(self) -> Float[Tensor, "p 36"]:
        """``basis^T basis`` of each point: what an error the same in all directions adds to a system."""
        return (self.basis.mT @ self.basis).flatten(1)

    @cached_property
    def pivot(self) -> Pivot:
        """What updates turn about: the middle of the points."""
        return Pivot.at_point(self.middle)


@dataclass(frozen=True, eq=False)
class Contact:
    """How measured points lie on the surface from each of h poses."""

    index: Int[Tensor, "h p"]  # the nearest surfel
    across: Float[Tensor, "h p"]  # metres out of its plane
    normal: Float[Tensor, "h p 3"]  # world
    along: Float[Tensor, "h p 3"]  # metres, the way to the point within the plane; world
    share: Float[Tensor, "h p"]  # of it that lies beyond the surfel itself
    rotation: Float[Tensor, "h 3 3"]

    @property
    def squared(self) -> Float[Tensor, "h p"]:
        """Squared distance from the surfel (metres^2), taken as a flat disc."""
        return self.across**2 + self.share**2 * (self.along**2).sum(-1)


def contact(surface: SurfaceMap, cloud: Cloud, T: SE3) -> Contact:
    """A point beside an edge lies in the plane of the surfel there, but not on the surfel: that is what ``share`` is for."""
    rotation, translation = T.rotation.to(cloud.points), T.translation.to(cloud.points)
    world = cloud.points @ rotation.mT + translation[:, None]
    index = surface.touch(world)
    offset = world - surface.surfels.positions[index]
    normal = surface.surfels.normals[index]
    across = (offset * normal).sum(-1)
    along = offset - across[..., None] * normal
    length = torch.linalg.vector_norm(along, dim=-1)
    share = (1 - BESIDE * surface.cell / length.clamp(min=1e-12)).clamp(min=0)
    return Contact(index, across, normal, along, share, rotation)


def alignment(surface: SurfaceMap, cloud: Cloud, scales: Scales, T: SE3) -> System:
    """Mean over points of ``(1 - n) + w (1 - n a)`` for each of the poses ``T``: n falls from 1 to 0 with the distance d
    from the nearest surfel, a with the difference c between the colour there and the measured one.

    The system is that of iteratively reweighted least squares: its gradient is exact, its Hessian positive semidefinite.
    """
    touch = contact(surface, cloud, T)
    near = falling(touch.squared, scales.distance)
    weight = near**2 / scales.distance**2
    if not scales.colour_weight:
        return System((1 - near).mean(-1).double(), *_distances(touch, cloud, weight))
    tint, gradient = colours(surface, touch, cloud)
    alike = falling((tint**2).sum(-1), scales.colour)
    system = _distances(touch, cloud, weight * (1 + scales.colour_weight * alike))
    tinted = _tints(tint, gradient, scales.colour_weight * near * alike**2 / scales.colour**2, touch, cloud)
    return System(_cost(near, alike, scales), *(a + b for a, b in zip(system, tinted, strict=True)))


def cost(surface: SurfaceMap, cloud: Cloud, scales: Scales, T: SE3) -> Float[Tensor, "h"]:
    """That of ``alignment``, without the time that derivatives take."""
    touch = contact(surface, cloud, T)
    near = falling(touch.squared, scales.distance)
    if not scales.colour_weight:
        return (1 - near).mean(-1).double()
    tint, _ = colours(surface, touch, cloud)
    return _cost(near, falling((tint**2).sum(-1), scales.colour), scales)


def _cost(near: Float[Tensor, "h p"], alike: Float[Tensor, "h p"], scales: Scales) -> Float[Tensor, "h"]:
    return ((1 - near).mean(-1) + scales.colour_weight * (1 - near * alike).mean(-1)).double()


def misfit(surface: SurfaceMap, cloud: Cloud, scales: Scales, T: SE3) -> Float[Tensor, "h"]:
    """Weighted mean of the squared residuals of ``alignment``, in units of their scales: the variance of one of them."""
    touch = contact(surface, cloud, T)
    tint, _ = colours(surface, touch, cloud)
    squared = torch.stack([touch.squared / scales.distance**2, (tint**2).sum(-1) / scales.colour**2])
    near, alike = falling(squared, 1.0)
    weights = torch.stack([near**2, scales.colour_weight * near * alike**2])
    total = (weights * squared).sum((0, -1))
    return (total / weights.sum((0, -1)).clamp(min=1e-12)).double()


def falling(squared: Float[Tensor, "*s h p"], scale: float) -> Float[Tensor, "*s h p"]:
    """1 at 0, a half at ``scale``."""
    return 1 / (1 + squared / scale**2)


def colours(
    surface: SurfaceMap, touch: Contact, cloud: Cloud
) -> tuple[Float[Tensor, "h p 3"], Float[Tensor, "h p 3 3"]]:
    """Colour of the surface at each point minus the measured one, and its derivative by place (channel by axis, world)."""
    gradient = surface.surfels.rgb_gradient[touch.index]
    change = (gradient @ touch.along[..., None])[..., 0]
    believed = change.abs() < STEEPEST
    rgb = surface.surfels.rgb[touch.index] + change.clamp(-STEEPEST, STEEPEST)
    return rgb - cloud.rgb, gradient * believed[..., None]


def _distances(touch: Contact, cloud: Cloud, weight: Float[Tensor, "h p"]) -> tuple[Tensor, Tensor]:
    """Gradient and Hessian of half the weighted squared distances, by their split into plane and all directions:
    ``n n^T + s (1 - n n^T) = (1 - s) n n^T + s``, which leaves out that s itself changes.
    """
    count = len(cloud)
    spread = weight * touch.share
    flat = weight - spread
    normal = touch.normal @ touch.rotation  # in the camera's axes
    rows = torch.cat(
        [normal, torch.linalg.cross((cloud.points - cloud.middle).expand_as(normal), normal)], -1
    )
    hessian = (rows * flat[..., None]).mT @ rows + (spread @ cloud.squares).unflatten(-1, (6, 6))
    pull = (weight * touch.across)[..., None] * touch.normal + spread[..., None] * touch.along
    return _gradient(pull, touch, cloud) / count, (hessian / count).double()


def _tints(
    error: Float[Tensor, "h p 3"], derivative: Float[Tensor, "h p 3 3"], weight: Tensor, touch: Contact, cloud: Cloud
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Gradient and Hessian of half the weighted squares of three residuals a point."""
    count = len(cloud)
    rows = ((derivative @ touch.rotation[:, None]) @ cloud.basis).flatten(1, 2)
    hessian = (rows * weight.repeat_interleave(3, dim=-1)[..., None]).mT @ rows
    pull = weight[..., None] * (derivative.mT @ error[..., None])[..., 0]
    return _gradient(pull, touch, cloud) / count, (hessian / count).double()


def _gradient(pull: Float[Tensor, "h p 3"], touch: Contact, cloud: Cloud) -> Float[Tensor, "h 6"]:
    """Sum over points of ``basis^T R^T pull``."""
    local = (pull @ touch.rotation).flatten(1)
    return (local @ cloud.basis.reshape(-1, 6)).double()
