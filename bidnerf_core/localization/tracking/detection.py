"""Landmarks of the map that are recognised around a predicted pose, and the evidence that a pose by landmarks is right."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame
from bidnerf_core.localization.search.chance import log10_nfa
from bidnerf_core.localization.search.correspondences import LandmarkMatches, QueryImage, query_image
from bidnerf_core.localization.search.guided import OBLIQUE, guided_matches
from bidnerf_core.localization.search.landmarks import LOOSE, THRESHOLD, LandmarkPose
from bidnerf_core.localization.search.matching import EXACT, LandmarkMatcher
from bidnerf_core.localization.search.unguided import unguided_matches
from bidnerf_core.localization.tracking.points import FollowedPoints, PointFit, fit_pose
from bidnerf_core.mapping.features import Features, paired_squared_distances
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.se3 import SE3

NEARBY = EXACT
"""Largest number of landmarks that are compared with an image: those that most images of the map saw."""
WIDE = 2.0
"""Multiple of the radius of guided matching from which on keypoints are compared with all landmarks in view. Guided matching
compares a keypoint with the few landmarks that project nearest to it, which suits predictions that are off by little.
"""
CELLS = 8
"""Cells along each axis of the grid over which the matches of an image should spread."""
LEAST_CHANCE = 0.5
"""Least number of matches by chance that is assumed, since it is estimated from a single count."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """How much a pose by landmarks is supported; see ``LandmarkPose``."""

    matches: int
    agreeing: int
    log10_nfa: float
    chance: float


@dataclass(frozen=True, eq=False)
class Recognized:
    """Landmarks that were found in an image by their descriptors, and the pose that they determine."""

    points: FollowedPoints
    found: PointFit
    evidence: Evidence
    usual_distance: float  # largest squared descriptor distance at which a match was allowed


@dataclass(frozen=True, eq=False)
class LandmarkDetector:
    """Recognises landmarks around a predicted pose, without a search over the map."""

    landmarks: LandmarkMap
    features: Features

    def __call__(
        self, frame: Frame, T_world_camera: SE3, radius: float, most_distance: float, noise: float
    ) -> Recognized | None:
        """Match keypoints with landmarks that project within ``radius`` pixels of them, and fit the pose to the matches.

        ``most_distance`` is the largest squared distance between the descriptors of a match, ``noise`` a first guess at that
        of keypoints (pixels). Returns None if too few match.
        """
        image = query_image(frame, SE3.identity(), self.features)
        number = self._near(frame.intrinsics, T_world_camera)
        near, threshold = self.landmarks[number], pixel_threshold(frame.intrinsics)
        tight = 1.5 * threshold
        seen = self._seen(frame, image, near, T_world_camera, radius, most_distance, noise)
        surprise = 0.0
        if seen is not None and (radius > tight or math.isinf(most_distance)):
            if radius > WIDE * tight:
                within = min(0.5, (threshold / radius) ** 2)
                surprise = log10_nfa(len(seen[0]), seen[1].within(threshold), within)
            T, noise = seen[1].T_world_camera, seen[1].fit.noise
            most_distance = seen[2] if math.isinf(most_distance) else most_distance
            seen = self._seen(frame, image, near, T, tight, most_distance, noise)
        if seen is None:
            return None
        points, found, _ = seen
        evidence = self._evidence(image, near, found, tight, most_distance)
        evidence = replace(evidence, log10_nfa=min(evidence.log10_nfa, surprise))
        followed = replace(points, landmark=number[points.landmark])
        return Recognized(followed, found, evidence, most_distance)

    def _seen(
        self,
        frame: Frame,
        image: QueryImage,
        near: LandmarkMap,
        T_world_camera: SE3,
        radius: float,
        most_distance: float,
        noise: float,
    ) -> tuple[FollowedPoints, PointFit, float] | None:
        """Return the matches within a radius, the pose that they determine, and the usual distance of its inliers."""
        threshold = pixel_threshold(frame.intrinsics)
        if radius > WIDE * 1.5 * threshold:
            matches = _matches_within([image], near, T_world_camera, radius)
        else:
            matches = guided_matches([image], near, T_world_camera, radius, most_distance)
        points = _points(near, image, matches)
        found = fit_pose(points.observed(frame), T_world_camera, noise, threshold)
        if found is None or not bool(found.inliers.any()):
            return None
        return points, found, _usual_distance(image, near, matches[found.inliers])

    def _near(self, camera: Intrinsics, T_world_camera: SE3) -> Int[Tensor, "n"]:
        """Return the numbers of landmarks in view that most images of the map saw, from about this direction."""
        landmarks = self.landmarks
        local = T_world_camera.inverse().to(torch.float32).apply(landmarks.positions)
        half = torch.tensor([camera.width / 2 / camera.fx, camera.height / 2 / camera.fy])
        middle = torch.tensor([0.5 - camera.cx / camera.width, 0.5 - camera.cy / camera.height]) * 2 * half
        inside = ((local[:, :2] - middle * local[:, 2:]).abs() <= 1.3 * half * local[:, 2:]).all(-1)
        towards = T_world_camera.translation.float() - landmarks.positions
        cosine = (towards * landmarks.directions).sum(-1) / towards.norm(dim=-1).clamp(min=1e-12)
        facing = cosine >= (landmarks.cones + OBLIQUE).clamp(max=torch.pi).cos()
        index = (inside & facing).nonzero()[:, 0]
        if len(index) <= NEARBY:
            return index
        return index[landmarks.views[index].argsort(descending=True, stable=True)[:NEARBY].sort().values]

    def _evidence(
        self, image: QueryImage, near: LandmarkMap, found: PointFit, radius: float, most: float
    ) -> Evidence:
        """Compare the number of matches with that around a shifted projection, where all of them are due to chance."""
        agreeing, keypoints = int(found.inliers.sum()), len(image.keypoints)
        shift = (4 * radius, 0.0) if agreeing % 2 else (0.0, 4 * radius)
        chance = len(guided_matches([image], near, found.T_world_camera, radius, most, 1.0, shift))
        probability = min(0.5, max(LEAST_CHANCE, chance) / max(1, keypoints))
        return Evidence(keypoints, agreeing, log10_nfa(keypoints, agreeing, probability), chance)


def pixel_threshold(camera: Intrinsics) -> float:
    """Return the largest reprojection error (pixels) of an observation that agrees with a pose."""
    return max(2.0, THRESHOLD * math.hypot(camera.width, camera.height))


def flow_evidence(found: PointFit, camera: Intrinsics) -> Evidence:
    """Return the evidence of landmarks that the optical flow has carried over from an earlier image.

    Each is one match, which would fall anywhere in the image if the flow were wrong.
    """
    threshold, count = pixel_threshold(camera), len(found.inliers)
    probability = min(0.5, math.pi * threshold**2 / (camera.width * camera.height))
    agreeing = found.within(threshold)
    return Evidence(count, agreeing, log10_nfa(count, agreeing, probability), 0.0)


def landmark_pose(
    points: FollowedPoints, found: PointFit, evidence: Evidence, landmarks: LandmarkMap, camera: Intrinsics
) -> LandmarkPose:
    """Return a pose by landmarks in the form that ``landmark_verdict`` judges."""
    T, data, count = found.T_world_camera, found.data, len(points)
    every = torch.arange(count)
    known = data.depth > 0
    ratio = data.in_camera(T)[known, 2] / data.depth[known]
    return LandmarkPose(
        T_world_camera=T,
        covariance=found.fit.covariance[:6, :6],
        map_covariance=found.fit.covariance[:6, :6] + landmarks.pose_covariance,
        noise=found.fit.noise,
        correspondences=LandmarkMatches(torch.zeros_like(every), every, points.landmark, torch.zeros(count)),
        residuals=data.residuals(T),
        normalized_residuals=data.normalized_residuals(T, found.fit.noise),
        pixels=points.pixels,
        matches=evidence.matches,
        agreeing=evidence.agreeing,
        log10_nfa=evidence.log10_nfa,
        chance=evidence.chance,
        spread=len(cells_of(points.pixels[found.inliers], camera).unique()) / CELLS**2,
        focal_factor=1.0,
        depth_scale=float(ratio.median()) if len(ratio) >= 6 else None,
    )


def cells_of(pixels: Float[Tensor, "m 2"], camera: Intrinsics) -> Int[Tensor, "m"]:
    """Return the number of the cell of a grid over the image in which each pixel lies."""
    size = torch.tensor([camera.width, camera.height])
    column, row = (pixels / size * CELLS).long().clamp(0, CELLS - 1).unbind(-1)
    return row * CELLS + column


def well_spread(pixels: Float[Tensor, "m 2"], camera: Intrinsics, most: int) -> Int[Tensor, "k"]:
    """Return up to ``most`` indices, from all cells of the grid in turn; the pixels come best first."""
    if len(pixels) <= most:
        return torch.arange(len(pixels))
    cell = cells_of(pixels, camera)
    order = cell.argsort(stable=True)
    first = torch.searchsorted(cell[order], cell[order])
    rank = torch.empty_like(cell)
    rank[order] = torch.arange(len(cell)) - first
    return rank.argsort(stable=True)[:most].sort().values


def _points(near: LandmarkMap, image: QueryImage, matches: LandmarkMatches) -> FollowedPoints:
    return FollowedPoints.of_landmarks(near, matches.landmark, image.keypoints.pixels[matches.keypoint])


def _matches_within(
    images: list[QueryImage], near: LandmarkMap, T_world_camera: SE3, radius: float
) -> LandmarkMatches:
    """Return the matches by descriptors, least ambiguous first, whose landmarks project within ``radius`` pixels."""
    (image,) = images
    matches = unguided_matches(images, LandmarkMatcher(near))
    local = T_world_camera.inverse().to(torch.float32).apply(near.positions[matches.landmark])
    off = (local[:, :2] / local[:, 2:] - image.rays[matches.keypoint, :2]) * image.focal
    return matches[(local[:, 2] > 0) & (off.square().sum(-1) <= radius**2)]


def _usual_distance(image: QueryImage, near: LandmarkMap, matches: LandmarkMatches) -> float:
    distance = paired_squared_distances(
        image.keypoints.descriptors, near.descriptors, matches.keypoint, matches.landmark
    )
    return LOOSE**2 * float(distance.quantile(0.9))
