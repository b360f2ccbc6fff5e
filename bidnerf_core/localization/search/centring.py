"""Centring: shifting a camera so that what it renders lies where what it measured lies.

Most of a wrong start is that what the camera saw is elsewhere in its image. Shifting the camera until the medians of the
rendered and of the measured points agree removes that in one rendering of a few rays, from where no gradient leads.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.field import RadianceField, SceneBounds
from bidnerf_core.localization.costs.linearization import flattened
from bidnerf_core.observations import Observations
from bidnerf_core.rendering import render
from bidnerf_core.se3 import SE3


@torch.no_grad()
def centred(field: RadianceField, observed: Observations, bounds: SceneBounds, T: SE3) -> SE3:
    """Return poses (h), each shifted; where nothing was measured or nothing is rendered, a pose stays as it is."""
    if not bool(observed.measured.any()):
        return T
    measured = observed.points[observed.measured].median(0).values
    shift = rendered_middle(field, observed, bounds, T) - measured
    shift = torch.where(shift.isfinite(), shift, 0).to(T.translation)
    return SE3(T.rotation, T.translation + (T.rotation @ shift[..., None])[..., 0])


def rendered_middle(
    field: RadianceField, observed: Observations, bounds: SceneBounds, T: SE3
) -> Float[Tensor, "h 3"]:
    """Return the median by axis of the points that rays meet, in the last camera's frame; NaN where they meet none."""
    rays = observed.rays(T, bounds)
    shape = rays.near.shape
    seen = render(field, flattened(rays), bounds.background)
    distance = torch.where(seen.opacity > 0.5, seen.distance / seen.opacity.clamp(min=0.5), torch.nan)
    points = observed.origins + distance.reshape(shape)[..., None] * observed.directions
    return points.nanmedian(1).values
