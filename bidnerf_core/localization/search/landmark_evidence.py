"""The evidence for a pose by landmarks: how many agree with it, how many would by chance, and where they lie."""

from __future__ import annotations

import math

import torch

from bidnerf_core.localization.search.chance import log10_nfa
from bidnerf_core.localization.search.correspondences import LandmarkMatches
from bidnerf_core.localization.search.guided_refinement import GuidedPose
from bidnerf_core.localization.search.landmark_pose import LandmarkPose
from bidnerf_core.localization.search.landmark_query import LandmarkQuery

LEAST_DEPTHS = 6
"""Least number of measured depths that give a depth scale."""
CELLS = 8
"""Rows and columns into which an image is divided to see how far the correspondences spread."""


def described(
    query: LandmarkQuery, matches: LandmarkMatches, answer: GuidedPose, seconds: dict[str, float]
) -> LandmarkPose:
    """Return a refined pose with the evidence for it; ``matches`` are those by descriptors alone."""
    fit = answer.fit
    data = query.observed(answer.correspondences).corrected(fit.calibration)
    off = query.observed(matches).corrected(fit.calibration).residuals(fit.T_world_rig)
    agreeing = int((torch.linalg.vector_norm(off, dim=-1) <= query.threshold).sum())
    z, known = data.in_camera(fit.T_world_rig)[:, 2], data.depth > 0
    ratio = z[known] / data.depth[known]
    return LandmarkPose(
        T_world_camera=fit.T_world_rig,
        covariance=fit.covariance + query.landmarks.pose_covariance,
        noise=fit.noise,
        correspondences=answer.correspondences,
        residuals=data.residuals(fit.T_world_rig),
        normalized_residuals=data.normalized_residuals(fit.T_world_rig, fit.noise),
        pixels=query.pixels(answer.correspondences),
        matches=len(matches),
        agreeing=agreeing,
        log10_nfa=log10_agreement(query, matches, agreeing),
        chance=answer.chance,
        visible=answer.visible,
        keypoints=sum(len(image.keypoints) for image in query.images),
        noise_ratio=fit.noise / query.landmarks.noise,
        spread=_spread(query, answer.correspondences),
        distance=float(z.median()),
        calibration=fit.calibration,
        calibration_deviations=fit.calibration_deviations,
        slope=fit.slope,
        miscalibration=answer.miscalibration,
        calibration_scatter=query.landmarks.calibration_scatter,
        depth_scale=float(ratio.median()) if len(ratio) >= LEAST_DEPTHS else None,
        seconds=seconds,
    )


def log10_agreement(query: LandmarkQuery, matches: LandmarkMatches, agreeing: int) -> float:
    """Return the logarithm of the number of false alarms if ``agreeing`` of ``matches`` are inliers."""
    camera = query.images[-1].intrinsics
    # A wrong match lies anywhere in the image.
    probability = min(0.5, math.pi * query.threshold**2 / (camera.width * camera.height))
    return log10_nfa(len(matches), agreeing, probability)


def _spread(query: LandmarkQuery, found: LandmarkMatches) -> float:
    """Return the share of an image's cells that hold a correspondence, averaged over the views."""
    shares, pixels = [], query.pixels(found)
    for number, image in enumerate(query.images):
        size = torch.tensor([image.intrinsics.width, image.intrinsics.height])
        cell = (pixels[found.view == number] / size * CELLS).long().clamp(0, CELLS - 1)
        shares.append(len(cell.unique(dim=0)) / CELLS**2)
    return sum(shares) / len(shares)
