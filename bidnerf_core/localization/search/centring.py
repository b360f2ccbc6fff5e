"""Centring: shift a camera to align the middle of the rendered points with that of the measured points.

At a wrong start, the main error is that the scene appears in another part of the image. Shifting the camera until the medians of
the rendered and measured points agree removes this error with one rendering of a few rays, even where the loss has no useful
gradient.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.fields.contract import RadianceField, SceneBounds
from bidnerf_core.fields.observations import Observations
from bidnerf_core.fields.rendering import render
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.costs.linearization import flattened


@torch.no_grad()
def centred(field: RadianceField, observed: Observations, bounds: SceneBounds, T: SE3) -> SE3:
    """Return the poses T (h) after centring; a pose is unchanged if nothing is measured or nothing is rendered."""
    points = torch.where(observed.measured[:, None], observed.points, torch.nan)
    measured = points.nanmedian(0).values  # NaN where nothing was measured
    shift = rendered_middle(field, observed, bounds, T) - measured
    shift = torch.where(shift.isfinite(), shift, 0).to(T.translation)
    return SE3(T.rotation, T.translation + (T.rotation @ shift[..., None])[..., 0])


def rendered_middle(
    field: RadianceField, observed: Observations, bounds: SceneBounds, T: SE3
) -> Float[Tensor, "h 3"]:
    """Return the median of the rendered points along each axis, in the last camera's frame; NaN if no ray hits anything."""
    rays = observed.rays(T, bounds)
    shape = rays.near.shape
    seen = render(field, flattened(rays), bounds.background)
    distance = torch.where(seen.opacity > 0.5, seen.distance / seen.opacity.clamp(min=0.5), torch.nan)
    points = observed.origins + distance.reshape(shape)[..., None] * observed.directions
    return points.nanmedian(1).values
