"""Points to track: landmarks recognised around a predicted pose, and corners with measured depth.

Landmarks give the camera's pose in the map; corners give the motion between consecutive frames with depth (odometry).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.depth import UNKNOWN, DepthNoise
from bidnerf_core.frames import Frame, View, visible_at
from bidnerf_core.geometry import CORNERS_PER_INDEPENDENT, SE3
from bidnerf_core.localization.landmarks.chance import log10_nfa
from bidnerf_core.localization.landmarks.correspondences import LandmarkMatches
from bidnerf_core.localization.landmarks.evidence import (
    cell_numbers,
    landmark_pose,
    probability_within,
    share_of_cells,
)
from bidnerf_core.localization.landmarks.guided import (
    OBLIQUE,
    guided_matches,
    projected_landmarks,
    slopes_in_view,
)
from bidnerf_core.localization.landmarks.guided_pose import RADII, matches_by_chance
from bidnerf_core.localization.landmarks.matching import EXHAUSTIVE, LandmarkMatcher, unguided_matches
from bidnerf_core.localization.landmarks.pose import CameraDoubt, LandmarkPose, MatchEvidence
from bidnerf_core.localization.landmarks.query import LandmarkQuery, pixel_threshold
from bidnerf_core.localization.tracking.flow import Grey, corners
from bidnerf_core.localization.tracking.motion import Motion
from bidnerf_core.localization.tracking.points import FRESH, FollowedPoints, PointFit, fit_pose, with_motion
from bidnerf_core.mapping import FIXED, GIVEN, Features, LandmarkMap, image_keypoints, measured_depth

WIDE = 2.0
"""Multiple of the radius of guided matching above which keypoints are compared with all landmarks in view. Guided matching
compares a keypoint with the few landmarks that project nearest to it, which suits accurate predictions.
"""
LEAST_CHANCE = 0.5
"""Lower limit of the number of matches by chance, since it is estimated from few counts."""


@dataclass(frozen=True, eq=False)
class Recognized:
    """Landmarks found in an image by their descriptors, and the pose that they determine."""

    points: FollowedPoints
    found: PointFit
    evidence: MatchEvidence
    doubt: CameraDoubt  # about the intrinsics


@dataclass(frozen=True, eq=False)
class LandmarkDetector:
    """Recognises landmarks around a predicted pose, without a search over the map."""

    landmarks: LandmarkMap
    features: Features

    def __call__(
        self,
        frame: Frame,
        T_world_camera: SE3,
        radius: float,
        noise: float,
        moves: bool = False,
    ) -> Recognized | None:
        """Match keypoints with landmarks that project within ``radius`` pixels of them, and fit the pose to the matches.

        ``noise`` is a first guess at that of keypoints (pixels), ``moves`` a guess as for ``fit_pose``. Returns None if too few
        keypoints match.
        """
        number = self._near(frame.intrinsics, T_world_camera)
        image = image_keypoints(View(frame, SE3.identity()), self.features)
        query = LandmarkQuery([image], self.landmarks[number], FIXED)
        tight = RADII[-1] * query.threshold
        seen = self._seen(frame, query, T_world_camera, radius, noise, moves)
        surprise = 0.0
        if seen is not None and radius > tight:
            if radius > WIDE * tight:
                within = min(0.5, (query.threshold / radius) ** 2)
                surprise = log10_nfa(len(seen[0]), seen[1].within(query.threshold), within)
            T, noise = seen[1].T_world_camera, seen[1].fit.noise
            seen = self._seen(frame, query, T, tight, noise, moves)
        if seen is None:
            return None
        points, found = seen
        found = with_motion(found, self.landmarks)
        evidence = _guided_evidence(query, found, tight)
        evidence = replace(evidence, log10_nfa=min(evidence.log10_nfa, surprise))
        points = replace(points, landmark=number[points.landmark])
        doubt = CameraDoubt() if found.judged is None else CameraDoubt.of(found.judged)
        return Recognized(points, found, evidence, doubt)

    def _seen(
        self,
        frame: Frame,
        query: LandmarkQuery,
        T: SE3,
        radius: float,
        noise: float,
        moves: bool,
    ) -> tuple[FollowedPoints, PointFit] | None:
        """Return the matches within a radius, and the pose that they determine."""
        if radius > WIDE * RADII[-1] * query.threshold:
            matches = _matches_within(query, T, radius)
        else:
            matches = guided_matches(query.images, query.landmarks, T, radius, query.max_distance)
        points = FollowedPoints.of_landmarks(query.landmarks, matches.landmark, query.pixels(matches))
        correlation = self.landmarks.correlation_of(len(points))
        found = fit_pose(points.observed(frame), T, noise, query.threshold, correlation, moves)
        if found is None or not bool(found.inliers.any()):
            return None
        return points, found

    def _near(self, camera: Intrinsics, T_world_camera: SE3) -> Int[Tensor, "n"]:
        """Return up to ``EXHAUSTIVE`` numbers of landmarks in view, mapped from roughly this direction, those in most images."""
        landmarks = self.landmarks
        slopes = slopes_in_view(camera, (camera.fx * camera.fy) ** 0.5)
        index, _ = landmarks.in_view(T_world_camera, slopes, OBLIQUE)
        if len(index) <= EXHAUSTIVE:
            return index
        return index[landmarks.views[index].argsort(descending=True, stable=True)[:EXHAUSTIVE].sort().values]


def _guided_evidence(query: LandmarkQuery, found: PointFit, radius: float) -> MatchEvidence:
    """Return the evidence from comparing the number of matches with that around shifted projections, which is due to chance."""
    agreeing, keypoints = int(found.inliers.sum()), len(query.images[0].keypoints)
    projections = projected_landmarks(query.images, query.landmarks, found.T_world_camera, GIVEN, radius)
    chance = matches_by_chance(projections, radius, query.max_distance)
    probability = min(0.5, max(LEAST_CHANCE, chance) / max(1, keypoints))
    nfa = log10_nfa(keypoints, agreeing, probability)
    return MatchEvidence(keypoints, agreeing, nfa, chance, sum(map(len, projections)), keypoints)


def flow_evidence(found: PointFit, camera: Intrinsics) -> MatchEvidence:
    """Return the evidence of landmarks tracked by optical flow from an earlier image.

    Each is one match, which would be anywhere in the image if the flow were wrong.
    """
    threshold, count = pixel_threshold(camera), len(found.inliers)
    agreeing = found.within(threshold)
    nfa = log10_nfa(count, agreeing, probability_within(threshold, camera))
    return MatchEvidence(count, agreeing, nfa, 0.0, count, count)


def tracked_pose(
    points: FollowedPoints, found: PointFit, evidence: MatchEvidence, landmarks: LandmarkMap, doubt: CameraDoubt,
    camera: Intrinsics,
) -> LandmarkPose:  # fmt: skip
    """Return a pose by landmarks in the form that ``landmark_verdict`` needs."""
    every = torch.arange(len(points))
    matches = LandmarkMatches(torch.zeros_like(every), every, points.landmark, torch.zeros(len(every)))
    return landmark_pose(
        found.fit, found.still_data, landmarks, evidence, matches, points.pixels,
        share_of_cells(points.pixels[found.inliers], camera), found.doubt_of_motion, doubt,
    )  # fmt: skip


def well_spread(pixels: Float[Tensor, "m 2"], camera: Intrinsics, most: int) -> Int[Tensor, "k"]:
    """Return up to ``most`` indices, taken in turn from the cells of a grid over the image; ``pixels`` are sorted best first."""
    if len(pixels) <= most:
        return torch.arange(len(pixels))
    cell = cell_numbers(pixels, camera)
    order = cell.argsort(stable=True)
    first = torch.searchsorted(cell[order], cell[order])
    rank = torch.empty_like(cell)
    rank[order] = torch.arange(len(cell)) - first
    return rank.argsort(stable=True)[:most].sort().values


def _matches_within(query: LandmarkQuery, T_world_camera: SE3, radius: float) -> LandmarkMatches:
    """Return the matches by descriptors, least ambiguous first, whose landmarks project within ``radius`` pixels."""
    (image,) = query.images
    matches = unguided_matches(query.images, LandmarkMatcher(query.landmarks), len(image.keypoints))
    return matches[
        torch.linalg.vector_norm(query.observed(matches).residuals(T_world_camera), dim=-1) <= radius
    ]


LEAST_CORNERS = 20
"""Minimum number of inlier corners of a motion."""
LEAST_SHARE = 0.5
"""Minimum inlier fraction of the corners."""
SIGNIFICANT_NFA = -6.0
"""Maximum log10 of the number of false alarms."""


@dataclass(frozen=True)
class Odometry:
    """Tracks up to ``count`` corners with measured depth of the given ``noise``."""

    count: int
    refresh_share: float  # remaining fraction of these at which new ones are detected
    noise: DepthNoise = UNKNOWN.noise

    def moved(
        self, frame: Frame, points: FollowedPoints, motion: Motion, start: SE3, seconds: float
    ) -> tuple[Motion, FollowedPoints] | None:
        """Return the state ``seconds`` after ``motion`` and its inlier corners; None if there are too few.

        ``start`` is the predicted pose, from which the fit starts.
        """
        threshold = pixel_threshold(frame.intrinsics)
        found = fit_pose(points.observed(frame), start, threshold / 2, threshold, CORNERS_PER_INDEPENDENT)
        if found is None:
            return None
        evidence = flow_evidence(found, frame.intrinsics)
        if (
            evidence.agreeing < max(LEAST_CORNERS, LEAST_SHARE * len(points))
            or evidence.log10_nfa > SIGNIFICANT_NFA
        ):
            return None
        relative = found.fit.covariance
        if not bool(relative.isfinite().all()):
            return None
        return motion.moved(found.T_world_camera, relative, seconds), points[found.inliers]

    def replenished(
        self, frame: Frame, image: Grey | None, points: FollowedPoints, T_world_camera: SE3
    ) -> FollowedPoints:
        """Return the corners among ``points``, or new ones at the pose of this frame if they have become few."""
        points = points[points.landmark == FRESH]
        if image is None or not frame.has_depth or len(points) >= self.refresh_share * self.count:
            return points
        apart = 0.7 * (image.shape[0] * image.shape[1] / self.count) ** 0.5
        pixels = corners(image, self.count, apart)
        pixels = pixels[visible_at(frame, pixels)]
        depth = measured_depth(frame, pixels)
        pixels, depth = pixels[depth > 0], depth[depth > 0]
        ray = frame.intrinsics.unproject(pixels.double())
        across = 0.5 * depth / frame.intrinsics.fx
        return FollowedPoints(
            pixels,
            T_world_camera.apply(ray * depth[:, None]),
            torch.stack([across, self.noise.deviation(depth)], dim=-1),
            -T_world_camera.rotate(torch.nn.functional.normalize(ray, dim=-1)),
            torch.full((len(pixels),), FRESH, dtype=torch.long),
        )
