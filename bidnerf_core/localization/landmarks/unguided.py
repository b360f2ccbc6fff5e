"""Unguided matching: the nearest landmark of each keypoint in descriptor space, before any pose is known."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.localization.landmarks.correspondences import LandmarkMatches, QueryImage
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap

LOOKED_UP = 4
"""Number of landmarks looked up per keypoint; the best one at another place determines the ambiguity of the match."""
SAME_PLACE = 2.0
"""Distance between landmarks, in diameters, below which they are duplicates of one point."""
AMBIGUITY = 0.9
"""Maximum ratio of a match's descriptor distance to that of the best landmark at another place (Lowe 2004)."""
LEAST_MATCHES = 60
"""Number of matches up to which the least ambiguous others are added to the unambiguous ones."""


def unguided_matches(
    images: Sequence[QueryImage], matcher: LandmarkMatcher, strongest: int
) -> LandmarkMatches:
    """Return the matches of keypoints with their nearest landmarks that pass the ratio test, least ambiguous first.

    Only the ``strongest`` keypoints of each image are matched.
    """
    parts = []
    for number, image in enumerate(images):
        distances, index = matcher.nearest(image.keypoints.descriptors[:strongest], LOOKED_UP)
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
    """Return the ratio of the descriptor distances of the nearest landmark and the best one at another place."""
    if not len(landmarks):
        return torch.ones(len(distances))
    position, size = landmarks.positions[index], landmarks.sizes[index]
    apart = torch.linalg.vector_norm(position - position[:, :1], dim=-1)
    near = SAME_PLACE * torch.maximum(size, size[:, :1]) + 3 * landmarks.deviations[index].amax(-1)
    elsewhere = torch.where(apart > near, distances, torch.inf).amin(1)
    # If all landmarks looked up are at one place, the last distance is a lower bound for any other.
    other = torch.where(elsewhere.isfinite(), elsewhere, distances[:, -1])
    return torch.where(other.isfinite(), (distances[:, 0] / other.clamp(min=1)).sqrt(), 0.0)
