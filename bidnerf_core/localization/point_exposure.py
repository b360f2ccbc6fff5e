"""Conversion of measured points' colours to the exposure of the map."""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.geometry.robust import Robust
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.costs.surface import PointCloud, SurfaceCost
from bidnerf_core.localization.exposure import clipped, robust_exposure

STRONGEST, MOST_BIAS = 4.0, 0.25
"""Maximum gain (its inverse is the minimum) and maximum bias of an exposure: two stops, and a quarter of the range."""
LEAST_COLOURED = 0.2
"""Minimum fraction of the points whose colours the camera did not clip."""
CLEARLY_MORE = 0.05
"""Minimum increase of the colour inliers by an exposure, as a fraction of all points, for it to be applied.

Blur also lowers contrast, but restoring that contrast only enlarges the differences.
"""


def cloud_with_exposure_of_map(cost: SurfaceCost, T: SE3) -> PointCloud:
    """Return the points of ``cost`` with their colours converted to the map's exposure.

    The exposure, a gain and a bias per channel, is fitted to the points that lie on the surface at the pose T. Points count as
    uncoloured if the camera clipped a colour and the exposure maps the surface's colour beyond black or white. The points are
    returned unchanged if the exposure is too far from the map's, too few points keep their colour, or hardly any more become
    colour inliers.
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
