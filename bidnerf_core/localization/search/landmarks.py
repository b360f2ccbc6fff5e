"""Search by landmarks: find a pose and its covariance from images alone, without a start."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.localization.search.chance import log10_nfa
from bidnerf_core.localization.search.correspondences import (
    LandmarkMatches,
    QueryImage,
    observed_points,
    query_images,
)
from bidnerf_core.localization.search.guided import guided_matches
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.ransac import Hypothesis, focal_consensus, sample_consensus
from bidnerf_core.localization.search.unguided import unguided_matches
from bidnerf_core.mapping.features import SIFT, Features, paired_squared_distances
from bidnerf_core.mapping.landmarks import LandmarkMap
from bidnerf_core.mapping.resection import ObservedPoints, ReprojectionFit, resect
from bidnerf_core.se3 import SE3

THRESHOLD = 0.005
"""Largest reprojection error of an inlier, as a share of the image's diagonal; never less than 2 pixels."""
RADII = (2.0, 1.0)
"""Radii of the rounds of guided matching, in units of 1.5 times the inlier threshold."""
GUIDED_ROUNDS = 3
"""Largest number of rounds of guided matching with the last radius; they end once the matches no longer change."""
LOOSE = 1.3
"""Largest descriptor distance of a guided match, in units of the 90 % quantile over the first inliers."""
DEPTH_OFF = 0.1
"""Largest relative difference between a landmark's depth and the depth that was measured at its keypoint."""
LEAST_INLIERS = 6
"""Least number of inliers for a pose to be returned at all."""


@dataclass(frozen=True, eq=False)
class FocalCheck:
    """The result of resection with a free focal length, started from the pose found with the given one."""

    factor: float  # of the focal length
    noise: float  # pixels: standard deviation of the reprojection errors with that factor
    slope: Float[Tensor, "6"]  # right update of the pose for a unit of the factor's logarithm

    @staticmethod
    def of(data: ObservedPoints, best: ReprojectionFit) -> FocalCheck:
        free = resect(data, best.T_world_rig, best.noise, True, best.focal_factor)
        return FocalCheck(free.focal_factor, free.noise, free.covariance[:6, 6] / free.covariance[6, 6])


@dataclass(frozen=True, eq=False)
class LandmarkPose:
    """A pose found by landmarks, its covariance, and the evidence for it."""

    T_world_camera: SE3  # of the last view, float64
    covariance: Float[
        Tensor, "6 6"
    ]  # of the right update, translation (metres) first; of keypoints and landmarks
    map_covariance: Float[Tensor, "6 6"]  # the same, with how the poses of the map's own images scatter
    noise: float  # pixels: standard deviation of the reprojection errors along each axis, robustly
    correspondences: LandmarkMatches  # those that the pose was refined on
    residuals: Float[Tensor, "m 2"]  # pixels, of the correspondences
    normalized_residuals: Float[Tensor, "m 2"]  # the same in standard deviations, those of landmarks included
    pixels: Float[Tensor, "m 2"]  # where the correspondences were observed, as the image has them
    matches: int  # by descriptors alone, before there was a pose
    agreeing: int  # of those, how many agree with the pose
    log10_nfa: (
        float  # logarithm of the number of as good agreements expected by chance (Moisan and Stival 2004)
    )
    chance: float  # correspondences that guided matching would find at a wrong pose
    spread: float  # 0 to 1: share of the image that the correspondences lie in
    focal_factor: float  # true focal length as a multiple of the given one; 1 where it was not sought
    depth_scale: (
        float | None
    )  # by which measured depth has to be multiplied; none where too little was measured
    # The focal length that the same correspondences give for a single view. None for several views.
    focal_check: FocalCheck | None = None
    seconds: dict[str, float] = field(default_factory=dict)  # by stage

    @property
    def inliers(self) -> int:
        """The number of correspondences within three standard deviations."""
        return int((torch.linalg.vector_norm(self.normalized_residuals, dim=-1) <= 3).sum())


def propose(
    matcher: LandmarkMatcher,
    views: Sequence[View],
    features: Features = SIFT,
    seed: int = 0,
    unknown_focal: bool = False,
) -> LandmarkPose | None:
    """Find the pose of the last of ``views``, whose relative poses are known; None if too few landmarks match.

    With ``unknown_focal``, the focal length of a single view is only a guess and is estimated along with the pose. Raises
    ``InputError`` if there is no view, or if there are several and the focal length is unknown.
    """
    if not views:
        raise InputError("nothing to localize: expected at least one view")
    if unknown_focal and len(views) > 1:
        raise InputError(f"an unknown focal length with {len(views)} views, expected one view")
    clock = _Clock()
    images = query_images(views, features)
    clock.lap("descriptors")
    matches = unguided_matches(images, matcher)
    clock.lap("matching")
    found = _first_pose(images, matcher.landmarks, matches, seed, unknown_focal)
    clock.lap("ransac")
    if found is None:
        return None
    answer = _refined(images, matcher.landmarks, matches, found, unknown_focal)
    clock.lap("refinement")
    if answer is None:
        return None
    correspondences, best, chance = answer
    return _described(images, matcher.landmarks, matches, correspondences, best, chance, clock.seconds)


def _first_pose(
    images: Sequence[QueryImage],
    landmarks: LandmarkMap,
    matches: LandmarkMatches,
    seed: int,
    unknown_focal: bool,
) -> Hypothesis | None:
    data = observed_points(images, landmarks, matches)
    threshold = _pixels(images, THRESHOLD)
    if unknown_focal:
        found = focal_consensus(data, threshold, seed)
    else:
        found = sample_consensus(data, matches.view, threshold, seed)
    if found is None or int(found.inliers.sum()) < LEAST_INLIERS:
        return None
    return found


def _pixels(images: Sequence[QueryImage], share: float) -> float:
    """Return a share of the last image's diagonal in pixels, at least 2."""
    camera = images[-1].intrinsics
    return max(2.0, share * math.hypot(camera.width, camera.height))


def _refined(
    images: Sequence[QueryImage],
    landmarks: LandmarkMap,
    matches: LandmarkMatches,
    found: Hypothesis,
    unknown_focal: bool,
) -> tuple[LandmarkMatches, ReprojectionFit, float] | None:
    """Refine the pose on the inliers, then on guided matches within shrinking radii until they no longer change.

    Returns the matches, the fit, and the number of matches expected by chance.
    """
    threshold = _pixels(images, THRESHOLD)
    inliers = matches[found.inliers]
    most = _usual_distance(images, landmarks, inliers)
    best = resect(
        observed_points(images, landmarks, inliers),
        found.T_world_rig,
        threshold / 2,
        unknown_focal,
        found.focal_factor,
    )
    correspondences = inliers
    for radius in (*RADII[:-1], *[RADII[-1]] * GUIDED_ROUNDS):
        guided = guided_matches(
            images, landmarks, best.T_world_rig, 1.5 * radius * threshold, most, best.focal_factor
        )
        data = observed_points(images, landmarks, guided)
        guided = guided[_depth_agrees(data, best.T_world_rig)]
        if len(guided) < LEAST_INLIERS:
            break
        unchanged = _same(guided, correspondences)
        correspondences = guided
        best = resect(
            observed_points(images, landmarks, guided),
            best.T_world_rig,
            best.noise,
            unknown_focal,
            best.focal_factor,
        )
        if unchanged:
            break
    chance = _chance(images, landmarks, best, 1.5 * RADII[-1] * threshold, most)
    return correspondences, best, chance


def _same(a: LandmarkMatches, b: LandmarkMatches) -> bool:
    return len(a) == len(b) and torch.equal(a.landmark, b.landmark) and torch.equal(a.keypoint, b.keypoint)


def _usual_distance(images: Sequence[QueryImage], landmarks: LandmarkMap, inliers: LandmarkMatches) -> float:
    """Return the largest squared descriptor distance of a guided match."""
    first = torch.tensor([0, *(len(image.keypoints) for image in images)]).cumsum(0)
    descriptors = torch.cat([image.keypoints.descriptors for image in images])
    number = first[inliers.view] + inliers.keypoint
    distance = paired_squared_distances(descriptors, landmarks.descriptors, number, inliers.landmark)
    return LOOSE**2 * float(distance.quantile(0.9))


def _depth_agrees(data: ObservedPoints, T_world_rig: SE3) -> Bool[Tensor, "m"]:
    """Return which correspondences have a landmark that fits the depth measured at the keypoint, or no measured depth."""
    z = data.in_camera(T_world_rig)[:, 2]
    known = data.depth > 0
    ratio = torch.where(known, z / torch.where(known, data.depth, 1), 1)
    scale = ratio[known].median() if int(known.sum()) >= LEAST_INLIERS else 1.0
    return (ratio / scale - 1).abs() <= DEPTH_OFF


def _chance(
    images: Sequence[QueryImage], landmarks: LandmarkMap, best: ReprojectionFit, radius: float, most: float
) -> float:
    """Return the number of guided matches expected by chance: the mean over four shifts of all projections."""
    away = 4 * radius
    counts = [
        len(guided_matches(images, landmarks, best.T_world_rig, radius, most, best.focal_factor, shift))
        for shift in ((away, 0.0), (-away, 0.0), (0.0, away), (0.0, -away))
    ]
    return sum(counts) / len(counts)


def _described(
    images: Sequence[QueryImage],
    landmarks: LandmarkMap,
    matches: LandmarkMatches,
    correspondences: LandmarkMatches,
    best: ReprojectionFit,
    chance: float,
    seconds: dict[str, float],
) -> LandmarkPose:
    data = observed_points(images, landmarks, correspondences)
    focused = data.with_focal(best.focal_factor)
    threshold = _pixels(images, THRESHOLD)
    off = (
        observed_points(images, landmarks, matches).with_focal(best.focal_factor).residuals(best.T_world_rig)
    )
    agreeing = int((torch.linalg.vector_norm(off, dim=-1) <= threshold).sum())
    known = data.depth > 0
    ratio = data.in_camera(best.T_world_rig)[known, 2] / data.depth[known]
    first = torch.tensor([0, *(len(image.keypoints) for image in images)]).cumsum(0)
    pixels = torch.cat([i.keypoints.pixels for i in images])[
        first[correspondences.view] + correspondences.keypoint
    ]
    return LandmarkPose(
        T_world_camera=best.T_world_rig,
        covariance=best.covariance[:6, :6],
        map_covariance=best.covariance[:6, :6] + landmarks.pose_covariance,
        noise=best.noise,
        correspondences=correspondences,
        residuals=focused.residuals(best.T_world_rig),
        normalized_residuals=focused.normalized_residuals(best.T_world_rig, best.noise),
        pixels=pixels,
        matches=len(matches),
        agreeing=agreeing,
        log10_nfa=log10_nfa(len(matches), agreeing, _probability(images, threshold)),
        chance=chance,
        spread=_spread(images, correspondences, pixels),
        focal_factor=best.focal_factor,
        depth_scale=float(ratio.median()) if len(ratio) >= LEAST_INLIERS else None,
        focal_check=FocalCheck.of(data, best) if len(images) == 1 else None,
        seconds=seconds,
    )


def _probability(images: Sequence[QueryImage], threshold: float) -> float:
    """Return the probability that a uniformly drawn point of the image lies within ``threshold`` pixels of a given one."""
    camera = images[-1].intrinsics
    return min(0.5, math.pi * threshold**2 / (camera.width * camera.height))


def _spread(images: Sequence[QueryImage], found: LandmarkMatches, pixels: Float[Tensor, "m 2"]) -> float:
    """Return the share of the cells of an 8 x 8 grid that hold a correspondence, averaged over the views."""
    shares = []
    for number, image in enumerate(images):
        size = torch.tensor([image.intrinsics.width, image.intrinsics.height])
        cell = (pixels[found.view == number] / size * 8).long().clamp(0, 7)
        shares.append(len(cell.unique(dim=0)) / 64)
    return sum(shares) / len(shares)


class _Clock:
    """A stopwatch that records the seconds of each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage], self._last = now - self._last, now
