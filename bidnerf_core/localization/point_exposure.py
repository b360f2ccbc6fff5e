"""The colours of measured points, brought to the exposure of the map."""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.localization.costs.surface import PointCloud, SurfaceCost
from bidnerf_core.localization.exposure import NEARLY_CLIPPED, robust_exposure
from bidnerf_core.robust import Robust
from bidnerf_core.se3 import SE3

STRONGEST = 4.0
"""Gain up to which, and down to whose inverse, an exposure is believed; it is some two stops."""
BRIGHTER = 1.1
"""Gain from which on points in which the camera clipped a colour count as uncoloured: they were brighter than they show."""
CLEARLY_MORE = 0.05
"""Share of the points that have to agree in colour in addition for an exposure to be taken.

Blur also lowers contrast, but to restore that only enlarges the differences.
"""


def cloud_with_exposure_of_map(cost: SurfaceCost, T: SE3) -> PointCloud:
    """Return the points of ``cost`` with the colours that they would have with the map's exposure.

    The exposure, one gain and bias for each channel, is fitted to the points that lie on the surface from pose T. The points
    are returned as they are where it is not believable, or hardly any more of them have the surface's colour with it.
    """
    found, cloud = cost.correspondences(T[None]), cost.cloud
    near, alike = cost.inliers(found)
    difference, _ = cost.colour_differences(found)
    measured = cloud.rgb.double()
    weights = (near[0] * cloud.coloured)[:, None].expand_as(measured).double()
    surface = difference.double() + measured
    fitted = robust_exposure(surface, measured, weights, Robust("geman-mcclure", cost.scales.colour))
    gain, bias = fitted.gain[0], fitted.bias[0]
    if not bool(((gain > 1 / STRONGEST) & (gain < STRONGEST)).all()):
        return cloud
    brighter = (gain > BRIGHTER) & (measured > 1 - NEARLY_CLIPPED)
    rgb = ((measured - bias) / gain).clamp(0, 1).to(cloud.rgb)
    exposed = replace(cloud, rgb=rgb, coloured=cloud.coloured & ~brighter.any(-1))
    _, then_alike = replace(cost, cloud=exposed).inliers(found)
    gained = float((near * (then_alike - alike)).mean())
    return exposed if gained > CLEARLY_MORE else cloud
