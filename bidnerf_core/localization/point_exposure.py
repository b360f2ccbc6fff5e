"""The colours of measured points, brought to the exposure of the map."""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.localization.costs.surface import PointCloud, SurfaceCost
from bidnerf_core.localization.exposure import robust_exposure, unclipped
from bidnerf_core.robust import Robust
from bidnerf_core.se3 import SE3

STRONGEST = 4.0
"""Gain up to which, and down to whose inverse, an exposure is believed; it is some two stops."""
BRIGHTER = 1.1
"""Gain from which on points in which the camera clipped a colour count as uncoloured: they were brighter than they show."""


def cloud_with_exposure_of_map(cost: SurfaceCost, T: SE3) -> PointCloud:
    """Return the points of ``cost`` with the colours that they would have with the map's exposure.

    The exposure, one gain and bias for each channel, is fitted to the points that lie on the surface from pose T. The points
    are returned as they are where it is not believable, as from a wrong pose.
    """
    found, cloud = cost.correspondences(T[None]), cost.cloud
    near, _ = cost.inliers(found)
    difference, _ = cost.colour_differences(found)
    measured, clear = cloud.rgb.double(), unclipped(cloud.rgb)
    weights = (near[0] * cloud.coloured)[:, None] * clear
    surface = difference.double() + measured
    fitted = robust_exposure(surface, measured, weights.double(), Robust("geman-mcclure", cost.scales.colour))
    gain, bias = fitted.gain[0], fitted.bias[0]
    if not bool(((gain > 1 / STRONGEST) & (gain < STRONGEST)).all()):
        return cloud
    brighter = (gain > BRIGHTER) & (measured > 0.5) & ~clear
    rgb = ((measured - bias) / gain).clamp(0, 1).to(cloud.rgb)
    return replace(cloud, rgb=rgb, coloured=cloud.coloured & ~brighter.any(-1))
