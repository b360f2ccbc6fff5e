"""Evidence that an image shows the scene as in a mirror: front cameras and faulty readers produce such images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from bidnerf_core.camera.orientation import Orientation
from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.landmarks.landmark_evidence import log10_agreement
from bidnerf_core.localization.landmarks.landmark_query import LandmarkQuery
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.search.correspondences import query_images
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.ransac import sample_consensus
from bidnerf_core.localization.search.unguided import unguided_matches
from bidnerf_core.mapping.geometry.calibration import FIXED
from bidnerf_core.mapping.landmarks.features import Features

KEYPOINTS = 700
"""Number of keypoints, the strongest of a mirrored image, that are matched."""
SUSPICIOUS = -150.0
"""Logarithm of the number of false alarms below which an image is not compared with its mirror image."""
SIGNIFICANT, DECISIVE, CLEAR = -30.0, 2.0, 1.5
"""Logarithm of the number of false alarms below which a mirror image is recognised; the image is mirrored if that logarithm is
below ``DECISIVE`` times its own, and ambiguous if its own is above ``CLEAR`` times that of the mirror image. Symmetric things
resemble their mirror images.
"""


@dataclass(frozen=True)
class MirrorEvidence:
    """How many landmarks the mirror image of a query matches."""

    agreeing: int
    log10_nfa: float  # logarithm of the number of such agreements expected by chance

    def rejection(self, log10_nfa: float) -> Verdict | None:
        """Return a rejection of a pose of the image with this ``log10_nfa``, or None.

        The image is mirrored if its mirror image is recognised and matches much better. If neither matches much better than
        the other, the pose is ambiguous.
        """
        if self.log10_nfa >= SIGNIFICANT:
            return None
        why = f"{self.agreeing} landmarks agree with the mirror image"
        if self.log10_nfa < DECISIVE * log10_nfa:
            return Verdict(Outcome.MIRRORED, why)
        if log10_nfa > CLEAR * self.log10_nfa:
            return Verdict(Outcome.AMBIGUOUS, f"{why}, about as well as with the image itself")
        return None


def mirror_evidence(
    matcher: LandmarkMatcher, views: Sequence[View], features: Features | None = None, seed: int = 0
) -> MirrorEvidence:
    """Match the mirror image of the last of ``views``, which no pose explains unless the view itself is mirrored."""
    frame = mirror_image(views[-1].frame)
    query = LandmarkQuery(
        query_images([View(frame, SE3.identity())], features or matcher.features), matcher.landmarks, FIXED
    )
    matches = unguided_matches(query.images, matcher, KEYPOINTS)
    found = sample_consensus(query.observed(matches), matches.view, query.threshold, seed)
    agreeing = 0 if found is None else int(found.inliers.sum())
    return MirrorEvidence(agreeing, log10_agreement(query, matches, agreeing))


def mirror_image(frame: Frame) -> Frame:
    """Return what the frame's camera would see in a mirror: left and right swapped, without depth."""
    swap = Orientation(mirrors_columns=True)
    alpha, hidden = (None if image is None else swap.upright(image) for image in (frame.alpha, frame.hidden))
    camera = frame.intrinsics.upright(swap)
    return replace(
        frame, rgb=swap.upright(frame.rgb), depth=None, alpha=alpha, hidden=hidden, intrinsics=camera
    )
