"""Matching before there is a pose: the landmark most alike to each keypoint, where it stands out."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.localization.search.correspondences import LandmarkMatches, QueryImage
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.mapping.landmarks import LandmarkMap

LOOKED_UP = 4
"""Landmarks that are looked up for each keypoint: the next best one elsewhere tells how ambiguous the best one is."""
SAME_PLACE = 2.0
"""Two landmarks nearer than so many of their diameters are one thing, seen twice."""
AMBIGUITY = 0.9
"""Distance of the descriptors as a share of that to the next best landmark elsewhere, at most."""
LEAST_MATCHES = 60
"""Fewer unambiguous matches than that are filled up with the least ambiguous others."""


def unguided_matches(images: Sequence[QueryImage], matcher: LandmarkMatcher) -> LandmarkMatches:
    """The landmark most alike to each keypoint, where it stands out; the least ambiguous ones first."""
    parts = []
    for number, image in enumerate(images):
        distances, index = matcher.nearest(image.keypoints.descriptors, LOOKED_UP)
        ambiguity = _ambiguity(matcher.landmarks, distances, index)
        keypoint = torch.arange(len(index))[distances[:, 0].isfinite()]
        part = LandmarkMatches(
            torch.full_like(keypoint, number), keypoint, index[keypoint, 0], ambiguity[keypoint]
        )
        parts.append(part)
    found = LandmarkMatches.cat(parts)
    found = found[found.ambiguity.argsort(stable=True)]
    return found[torch.arange(len(found)) < max(LEAST_MATCHES, int((found.ambiguity <= AMBIGUITY).sum()))]


def _ambiguity(
    landmarks: LandmarkMap, distances: Float[Tensor, "q k"], index: Int[Tensor, "q k"]
) -> Float[Tensor, "q"]:
    """Distance to the best landmark as a share of that to the best one elsewhere."""
    if not len(landmarks):
        return torch.ones(len(distances))
    position, size = landmarks.positions[index], landmarks.sizes[index]
    apart = torch.linalg.vector_norm(position - position[:, :1], dim=-1)
    near = SAME_PLACE * torch.maximum(size, size[:, :1]) + 3 * landmarks.deviations[index].amax(-1)
    elsewhere = torch.where(apart > near, distances, torch.inf).amin(1)
    # Where all that were looked up are in one place, the last of them bounds how near another can be.
    other = torch.where(elsewhere.isfinite(), elsewhere, distances[:, -1])
    return torch.where(other.isfinite(), (distances[:, 0] / other.clamp(min=1)).sqrt(), 0.0)
