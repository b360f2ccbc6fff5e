"""The middle of what is rendered brought to the middle of what was measured: a first step that no derivative gives.

Most of a wrong start is that what the camera saw is elsewhere in its image. Shifting the camera until the medians of the
rendered and of the measured points agree takes that away in one rendering of a few rays, from where no gradient leads.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.field import RadianceField, SceneBounds
from bidnerf_core.localization.linearization import flattened
from bidnerf_core.localization.ray_batch import RayBatch
from bidnerf_core.rendering import render
from bidnerf_core.se3 import SE3


@torch.no_grad()
def centred(field: RadianceField, batch: RayBatch, bounds: SceneBounds, T: SE3) -> SE3:
    """Poses (h), each shifted; where nothing was measured or nothing is seen, it stays."""
    measured = batch.distance > 0
    if not bool(measured.any()):
        return T
    there = (batch.origins + batch.distance[:, None] * batch.directions)[measured].median(0).values
    shift = rendered_middle(field, batch, bounds, T) - there
    shift = torch.where(shift.isfinite(), shift, 0).to(T.translation)
    return SE3(T.rotation, T.translation + (T.rotation @ shift[..., None])[..., 0])


def rendered_middle(
    field: RadianceField, batch: RayBatch, bounds: SceneBounds, T: SE3
) -> Float[Tensor, "h 3"]:
    """Median by axis of the points that rays meet, in the frame of the last camera; NaN where they meet none."""
    rays = batch.rays(T, bounds)
    shape = rays.near.shape
    seen = render(field, flattened(rays), bounds.background)
    distance = torch.where(seen.opacity > 0.5, seen.distance / seen.opacity.clamp(min=0.5), torch.nan)
    points = batch.origins + distance.reshape(shape)[..., None] * batch.directions
    return points.nanmedian(1).values
