"""The cost of measured points on a baked surface, with exact derivatives, for batches of poses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from bidnerf_core.devices import moved
from bidnerf_core.fields import Observations
from bidnerf_core.frames import View, observe, visible_at
from bidnerf_core.geometry import SE3, inlier_weight, skew
from bidnerf_core.localization.normal_equations import NormalEquations
from bidnerf_core.localization.solvers.pivots import Pivot
from bidnerf_core.mapping import SurfaceMap

SURFEL_RADIUS = 1.5
"""Radius of a surfel's disc, in cells of the surface's grid."""
MOST_DRAWN_FROM = 1_000_000
"""Number of a view's measured pixels above which they are evenly subsampled before points are drawn."""
MOST_COLOUR_CHANGE = 0.2
"""Maximum change of a surfel's colour to which its gradient is extrapolated within the plane."""


@dataclass(frozen=True)
class PointScales:
    """The residuals at which a point's inlier weight is one half, and the weight of colour relative to distance."""

    distance: float  # metres
    colour: float = 0.15  # norm of the difference over the three channels, each in [0, 1]
    colour_weight: float = 1.0


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Measured points with their colours, in the frame of the camera to be localized."""

    points: Float[Tensor, "p 3"]  # metres
    rgb: Float[Tensor, "p 3"]
    origins: Float[Tensor, "p 3"]  # metres: position of the sensor for each
    coloured: Bool[Tensor, "p"]  # whether a colour was measured
    # Derivative of the points (metres) with respect to errors common to all depths. If given, these are unknowns after the
    # pose's six.
    by_error: Float[Tensor, "p 3 e"] | None = None

    @staticmethod
    def measured(
        views: tuple[View, ...], depth_rays: Observations | None, count: int, generator: Generator
    ) -> PointCloud:
        """Return up to ``count`` measured points in random order, divided equally among the sensors; on the CPU.

        Points of ``depth_rays`` take their colours from the views in which they are visible.
        """
        share = -(-count // (len(views) + (depth_rays is not None)))
        parts = [_cloud_of(view, share, generator) for view in views]
        if depth_rays is not None:
            parts.append(_cloud_of_rays(depth_rays, views, share, generator))
        order = torch.randperm(sum(map(len, parts)), generator=generator)[:count]
        names = ("points", "rgb", "origins", "coloured")
        return PointCloud(*(torch.cat([getattr(part, name) for part in parts])[order] for name in names))

    def __len__(self) -> int:
        return len(self.points)

    def to(self, device: torch.device | str) -> PointCloud:
        """Return the points on another device; ``self`` if they are already there."""
        return moved(self, device)

    def first(self, count: int) -> PointCloud:
        """Return the first ``count`` points: a random sample, since their order is random."""
        by_error = None if self.by_error is None else self.by_error[:count]
        return PointCloud(
            self.points[:count], self.rgb[:count], self.origins[:count], self.coloured[:count], by_error
        )

    def corrected(self, factor: float, offset: float) -> PointCloud:
        """Return uncorrected points with distances multiplied by a factor and increased by an offset (metres).

        Factor and offset become unknowns, in this order.
        """
        lines = self.points - self.origins
        sight = torch.nn.functional.normalize(lines, dim=-1)
        points = self.origins + factor * lines + offset * sight
        return replace(self, points=points, by_error=torch.stack([lines, sight], -1))

    @cached_property
    def all_coloured(self) -> bool:
        return bool(self.coloured.all())

    @cached_property
    def middle(self) -> Float[Tensor, "3"]:
        """Median of the points along each axis."""
        return self.points.median(0).values

    @cached_property
    def basis(self) -> Float[Tensor, "p 3 k"]:
        """Jacobian of the points, in the camera's axes, with respect to an update about their middle and any shared errors."""
        turned = -skew(self.points - self.middle)
        eye = torch.eye(3, dtype=turned.dtype, device=turned.device)
        by_pose = torch.cat([eye.expand_as(turned), turned], dim=-1)
        return by_pose if self.by_error is None else torch.cat([by_pose, self.by_error], dim=-1)

    @cached_property
    def squares(self) -> Float[Tensor, "p kk"]:
        """``basis^T basis`` of each point: the contribution of an isotropic residual to the Hessian."""
        return (self.basis.mT @ self.basis).flatten(1)

    @cached_property
    def pivot(self) -> Pivot:
        """The middle of the points, about which updates rotate; on the CPU."""
        return Pivot.at_point(self.middle)


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Each measured point's nearest surfel and the offset from it, for each of h poses."""

    index: Int[Tensor, "h p"]  # of the surfel
    across: Float[Tensor, "h p"]  # metres out of its plane
    normal: Float[Tensor, "h p 3"]  # world
    along: Float[Tensor, "h p 3"]  # metres, the offset within the plane; world
    beyond: Float[Tensor, "h p"]  # fraction of that offset beyond the surfel's disc, 0 to 1
    rotation: Float[Tensor, "h 3 3"]

    @property
    def squared(self) -> Float[Tensor, "h p"]:
        """Squared distance from the surfel's disc (metres^2)."""
        return self.across**2 + self.beyond**2 * (self.along**2).sum(-1)


@dataclass(frozen=True, eq=False)
class SurfaceCost:
    """The cost of measured points on a surface: the mean over points of ``(1 - n) + w (1 - n a)``.

    The inlier weight n falls from 1 to 0 with the distance from the nearest surfel, a likewise with the difference between the
    surfel's colour and the measured one, and w is ``colour_weight``.

    Its normal equations are those of iteratively reweighted least squares: the gradient is exact, the Hessian positive
    semidefinite. They are computed on the device of the surface and returned on that of the poses.
    """

    surface: SurfaceMap
    cloud: PointCloud
    scales: PointScales

    def __post_init__(self) -> None:
        object.__setattr__(self, "cloud", self.cloud.to(self.surface.device))

    @property
    def pivot(self) -> Pivot:
        """The middle of the points, about which updates rotate; on the CPU."""
        return self.cloud.pivot

    def __call__(self, T: SE3) -> NormalEquations:
        return moved(self._equations(self.correspondences(T)), T.device)

    def with_variance(self, T: SE3) -> tuple[NormalEquations, Float[Tensor, "h"]]:
        """Return the normal equations and ``residual_variance``, with one search for neighbours."""
        found = self.correspondences(T)
        return moved((self._equations(found), self._variance(found)), T.device)

    def _equations(self, found: Correspondences) -> NormalEquations:
        scales = self.scales
        near = inlier_weight(found.squared, scales.distance)
        weight = near**2 / scales.distance**2
        if not scales.colour_weight:
            return NormalEquations((1 - near).mean(-1).double(), *_distance_terms(found, self.cloud, weight))
        difference, derivative = self.colour_differences(found)
        alike = inlier_weight((difference**2).sum(-1), scales.colour)
        gradient, hessian = _distance_terms(found, self.cloud, weight * (1 + scales.colour_weight * alike))
        colour_weight = scales.colour_weight * near * alike**2 / scales.colour**2
        by_colour = _colour_terms(difference, derivative, colour_weight, found, self.cloud)
        return NormalEquations(self._cost(near, alike), gradient + by_colour[0], hessian + by_colour[1])

    def cost(self, T: SE3) -> Float[Tensor, "h"]:
        """Return the cost alone, without computing derivatives."""
        near, alike = self.inliers(self.correspondences(T))
        colour = self.scales.colour_weight
        return moved(self._cost(near, alike) if colour else (1 - near).mean(-1).double(), T.device)

    def point_costs(self, T: SE3) -> Float[Tensor, "h p"]:
        """Return each point's cost, whose mean is the cost."""
        near, alike = self.inliers(self.correspondences(T))
        return moved((1 - near + self.scales.colour_weight * (1 - near * alike)).double(), T.device)

    def inliers(self, found: Correspondences) -> tuple[Float[Tensor, "h p"], Float[Tensor, "h p"]]:
        """Return each point's inlier weights by distance and by colour."""
        near = inlier_weight(found.squared, self.scales.distance)
        difference, _ = self.colour_differences(found)
        return near, inlier_weight((difference**2).sum(-1), self.scales.colour)

    def residual_variance(self, T: SE3) -> Float[Tensor, "h"]:
        """Return the weighted mean of the squared residuals, in units of their scales."""
        return moved(self._variance(self.correspondences(T)), T.device)

    def _variance(self, found: Correspondences) -> Float[Tensor, "h"]:
        scales = self.scales
        difference, _ = self.colour_differences(found)
        squared = torch.stack(
            [found.squared / scales.distance**2, (difference**2).sum(-1) / scales.colour**2]
        )
        near, alike = inlier_weight(squared, 1.0)
        by_colour = scales.colour_weight * self.cloud.coloured * near * alike**2
        weights = torch.stack([near**2, by_colour])
        total = (weights * squared).sum((0, -1))
        return (total / weights.sum((0, -1)).clamp(min=1e-12)).double()

    def correspondences(self, T: SE3) -> Correspondences:
        """Match each point with its nearest surfel, on the surface's device.

        A point beside an edge may lie in the plane of the nearest surfel but not on its disc; ``beyond`` accounts for this.
        """
        surface, points = self.surface, self.cloud.points
        rotation, translation = T.rotation.to(points), T.translation.to(points)
        world = points @ rotation.mT + translation[:, None]
        index = surface.nearest(world)
        offset = world - surface.surfels.positions[index]
        normal = surface.surfels.normals[index]
        across = (offset * normal).sum(-1)
        along = offset - across[..., None] * normal
        length = torch.linalg.vector_norm(along, dim=-1)
        beyond = (1 - SURFEL_RADIUS * surface.cell / length.clamp(min=1e-12)).clamp(min=0)
        return Correspondences(index, across, normal, along, beyond, rotation)

    def colour_differences(
        self, found: Correspondences
    ) -> tuple[Float[Tensor, "h p 3"], Float[Tensor, "h p 3 3"]]:
        """Return the surface's colour at each point minus the measured one, and its derivative with respect to the point's
        position (channel by world axis).
        """
        gradient = self.surface.surfels.rgb_gradient[found.index]
        change = (gradient @ found.along[..., None])[..., 0]
        trusted = change.abs() < MOST_COLOUR_CHANGE
        rgb = self.surface.surfels.rgb[found.index] + change.clamp(-MOST_COLOUR_CHANGE, MOST_COLOUR_CHANGE)
        difference, gradient = rgb - self.cloud.rgb, gradient * trusted[..., None]
        if self.cloud.all_coloured:
            return difference, gradient
        coloured = self.cloud.coloured[:, None]
        return difference * coloured, gradient * coloured[..., None]

    def _cost(self, near: Float[Tensor, "h p"], alike: Float[Tensor, "h p"]) -> Float[Tensor, "h"]:
        return ((1 - near).mean(-1) + self.scales.colour_weight * (1 - near * alike).mean(-1)).double()


def _cloud_of(view: View, count: int, generator: Generator) -> PointCloud:
    depth = torch.zeros((0, 0)) if view.frame.depth is None else view.frame.depth.cpu()
    measured = ((depth > 0) & depth.isfinite()).nonzero()
    measured = measured[:: max(1, len(measured) // MOST_DRAWN_FROM)]
    rows, columns = measured[torch.randperm(len(measured), generator=generator)[:count]].unbind(-1)
    seen = observe(view, torch.stack([columns, rows], dim=-1), device="cpu")
    return PointCloud(seen.points, seen.rgb, seen.origins, seen.coloured)


def _cloud_of_rays(
    depth_rays: Observations, views: tuple[View, ...], count: int, generator: Generator
) -> PointCloud:
    """Return the points of depth rays, in the last camera's frame, with the colours of the pixels to which they project."""
    some = depth_rays.drawn(count, generator, device="cpu")
    rgb, coloured = torch.zeros_like(some.points), torch.zeros(len(some), dtype=torch.bool)
    for view in views:
        camera = view.frame.intrinsics
        local = view.T_ref_camera.to(some.points).inverse().apply(some.points)
        pixels = camera.project(local)
        size = pixels.new_tensor([camera.width, camera.height])
        seen = ((pixels >= 0) & (pixels < size)).all(-1)  # false for NaN, behind the camera
        seen[seen.clone()] = visible_at(view.frame, pixels[seen])
        columns, rows = pixels[seen].long().unbind(-1)
        rgb[seen] = view.frame.colours_at(rows, columns).to(rgb)
        coloured |= seen
    return PointCloud(some.points, rgb, some.origins, coloured)


def _distance_terms(
    found: Correspondences, cloud: PointCloud, weight: Float[Tensor, "h p"]
) -> tuple[Tensor, Tensor]:
    """Return the gradient and the Hessian of half the weighted squared distances.

    A squared distance is split into a part across the plane and an isotropic part,
    ``n n^T + s (1 - n n^T) = (1 - s) n n^T + s``; the derivative of s itself is neglected.
    """
    count = len(cloud)
    spread = weight * found.beyond
    flat = weight - spread
    normal = found.normal @ found.rotation  # in the camera's axes
    turned = torch.linalg.cross((cloud.points - cloud.middle).expand_as(normal), normal)
    by_error = () if cloud.by_error is None else ((normal[..., None, :] @ cloud.by_error)[..., 0, :],)
    rows = torch.cat([normal, turned, *by_error], -1)
    hessian = (rows * flat[..., None]).mT @ rows + (spread @ cloud.squares).unflatten(-1, rows.shape[-1:] * 2)
    pull = (weight * found.across)[..., None] * found.normal + spread[..., None] * found.along
    return _gradient(pull, found, cloud) / count, (hessian / count).double()


def _colour_terms(
    error: Float[Tensor, "h p 3"], derivative: Float[Tensor, "h p 3 3"], weight: Tensor,
    found: Correspondences, cloud: PointCloud,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the gradient and the Hessian of half the weighted squares of each point's three residuals."""
    count = len(cloud)
    rows = ((derivative @ found.rotation[:, None]) @ cloud.basis).flatten(1, 2)
    hessian = (rows * weight.repeat_interleave(3, dim=-1)[..., None]).mT @ rows
    pull = weight[..., None] * (derivative.mT @ error[..., None])[..., 0]
    return _gradient(pull, found, cloud) / count, (hessian / count).double()


def _gradient(
    pull: Float[Tensor, "h p 3"], found: Correspondences, cloud: PointCloud
) -> Float[Tensor, "h k"]:
    """Return the sum over points of ``basis^T R^T pull``."""
    local = (pull @ found.rotation).flatten(1)
    return (local @ cloud.basis.flatten(0, 1)).double()
