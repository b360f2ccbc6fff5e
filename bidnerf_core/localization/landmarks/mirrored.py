"""Evidence that an image shows the scene as in a mirror: front cameras and faulty readers produce such images."""

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
"""Number of keypoints, the strongest of a mirrored image, that are matched."""


def mirror_evidence(matcher: LandmarkMatcher, view: View, seed: int = 0) -> tuple[int, float]:
    """Match the mirror image that a view holds.

    Returns how many landmarks agree with it, and the logarithm of the number of such agreements expected by chance.
    """
    query = LandmarkQuery(query_images([view], matcher.features), matcher.landmarks, FIXED)
    matches = unguided_matches(query.images, matcher, KEYPOINTS)
    found = sample_consensus(query.observed(matches), matches.view, query.threshold, seed)
    agreeing = 0 if found is None else int(found.inliers.sum())
    return agreeing, log10_agreement(query, matches, agreeing)


def mirror_image(frame: Frame) -> Frame:
    """Return what the frame's camera would see in a mirror: left and right swapped, without depth."""
    swap = Orientation(mirrors_columns=True)
    alpha, hidden = (None if image is None else swap.upright(image) for image in (frame.alpha, frame.hidden))
    camera = frame.intrinsics.upright(swap)
    return replace(
        frame, rgb=swap.upright(frame.rgb), depth=None, alpha=alpha, hidden=hidden, intrinsics=camera
    )
