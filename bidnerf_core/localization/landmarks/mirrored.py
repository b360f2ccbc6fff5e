"""Evidence that an image is mirrored, as front cameras and faulty readers produce it."""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.camera.orientation import Orientation
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.localization.landmarks.consensus import sample_consensus
from bidnerf_core.localization.landmarks.correspondences import query_images
from bidnerf_core.localization.landmarks.evidence import log10_agreement
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.localization.landmarks.unguided import unguided_matches
from bidnerf_core.mapping.geometry.calibration import FIXED

KEYPOINTS = 700
"""Number of the strongest keypoints of a mirrored image that are matched."""


def mirror_evidence(matcher: LandmarkMatcher, view: View, seed: int = 0) -> tuple[int, float]:
    """Match a view of the mirror image with the map.

    Returns the number of landmark inliers, and log10 of the number of false alarms.
    """
    query = LandmarkQuery(query_images([view], matcher.features), matcher.landmarks, FIXED)
    matches = unguided_matches(query.images, matcher, KEYPOINTS)
    found = sample_consensus(query.observed(matches), matches.view, query.threshold, seed)
    agreeing = 0 if found is None else int(found.inliers.sum())
    return agreeing, log10_agreement(query, matches, agreeing)


def mirror_image(frame: Frame) -> Frame:
    """Return the mirror image of a frame (left and right swapped), without depth."""
    swap = Orientation(mirrors_columns=True)
    alpha, hidden = (None if image is None else swap.upright(image) for image in (frame.alpha, frame.hidden))
    camera = frame.intrinsics.upright(swap)
    return replace(
        frame, rgb=swap.upright(frame.rgb), depth=None, alpha=alpha, hidden=hidden, intrinsics=camera
    )
