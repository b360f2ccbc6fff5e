"""Fusion of costs in different units: each is weighted by the inverse variance of its residuals."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.covariance import FINEST, LEAST_VARIANCE
from bidnerf_core.localization.normal_equations import Cost, Scaled
from bidnerf_core.mapping import SurfaceMap

SURFACE_MEASUREMENTS, RENDERED_MEASUREMENTS = 10.0, 300.0
"""Numbers of independent measurements that a view's points on the surface, and its rendered rays, count as."""
SCALED_MEASUREMENTS = 30.0
"""Number of independent measurements that a view's points count as where their scale is an unknown, not an error they share."""


@dataclass(frozen=True, eq=False)
class FusedTerm:
    """A cost with the variance of its residuals, so that costs in different units can be added."""

    cost: Cost
    variance: float
    measurements: float  # number of independent measurements that it counts as

    @property
    def weight(self) -> float:
        """Factor of the cost in a sum."""
        return self.measurements / self.variance

    @property
    def scaled(self) -> Cost:
        return Scaled(self.cost, self.weight)


def finest_cost(surface: SurfaceMap, cloud: PointCloud) -> SurfaceCost:
    """Return the cost of measured points at the finest scale of distances that the surface's cells allow."""
    return SurfaceCost(surface, cloud, PointScales(FINEST * surface.cell))


def surface_term(cost: SurfaceCost, T: SE3, views: int) -> FusedTerm:
    """Return the term of the points that ``views`` images measured; the variance is that of their residuals from ``T``."""
    variance = max(float(cost.residual_variance(T[None])[0]), LEAST_VARIANCE)
    return FusedTerm(cost, variance, SURFACE_MEASUREMENTS * views)


def rendered_term(cost: Cost, at_start: float, views: int) -> FusedTerm:
    """Return the term of the rays rendered for ``views`` images, whose cost is ``at_start`` before the descent."""
    return FusedTerm(cost, max(at_start, LEAST_VARIANCE), RENDERED_MEASUREMENTS * views)
