"""The colours of measured points, brought to the exposure of the map."""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.geometry.robust import Robust
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.costs.surface import PointCloud, SurfaceCost
from bidnerf_core.localization.exposure import clipped, robust_exposure

STRONGEST, MOST_BIAS = 4.0, 0.25
"""Largest gain (the least is its inverse) and largest bias of an exposure: two stops, and a quarter of the range."""
LEAST_COLOURED = 0.2
"""Least share of the points whose colours the camera did not clip."""
CLEARLY_MORE = 0.05
"""Share of all points that an exposure must add to those that agree in colour, for it to be applied.

Blur lowers contrast too, but restoring that contrast only enlarges the differences.
"""


def cloud_with_exposure_of_map(cost: SurfaceCost, T: SE3) -> PointCloud:
    """Return the points of ``cost`` with the colours that they would have with the map's exposure.

    The exposure, one gain and bias for each channel, is fitted to the points that pose T places on the surface. Points count as
    uncoloured where the camera clipped a colour, and the exposure takes the surface's colour beyond black or white. The points
    are returned as they are if the exposure is too far from the map's, too few keep their colour, or the exposure makes hardly
    any more of them agree with the surface's colour.
    """
    found, cloud = cost.correspondences(T[None]), cost.cloud
    near, alike = cost.inliers(found)
    difference, _ = cost.colour_differences(found)
    measured = cloud.rgb.double().mT
    weights = (near[0] * cloud.coloured).expand_as(measured).double()
    surface = difference.double().mT + measured
    fitted = robust_exposure(surface, measured, weights, Robust("geman-mcclure", cost.scales.colour))
    gain, bias = fitted.gain[0], fitted.bias[0]
    kept = cloud.coloured & ~clipped(fitted.applied(surface), measured)[0].any(0)
    moderate = (gain > 1 / STRONGEST) & (gain < STRONGEST) & (bias.abs() < MOST_BIAS)
    if not bool(moderate.all()) or float(kept.double().mean()) < LEAST_COLOURED:
        return cloud
    exposed = replace(cloud, rgb=((measured.mT - bias) / gain).clamp(0, 1).to(cloud.rgb), coloured=kept)
    _, then_alike = replace(cost, cloud=exposed).inliers(found)
    gained = float((near * (then_alike - alike))[0, kept].sum()) / len(cloud)
    return exposed if gained > CLEARLY_MORE else cloud
