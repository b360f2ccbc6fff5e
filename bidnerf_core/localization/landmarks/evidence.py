"""The evidence for a pose by landmarks: its inliers, the number expected by chance, and their spread over the image."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.chance import log10_nfa
from bidnerf_core.localization.landmarks.correspondences import MIN_MATCHES, LandmarkMatches
from bidnerf_core.localization.landmarks.guided_pose import GuidedPose
from bidnerf_core.localization.landmarks.hypotheses import Whose
from bidnerf_core.localization.landmarks.pose import CameraDoubt, LandmarkPose, MatchEvidence
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.mapping import GIVEN, LandmarkMap, ObservedPoints, ReprojectionFit

CELLS = 8
"""Number of rows and columns of cells by which the spread of correspondences over an image is measured."""


def described(answer: GuidedPose) -> LandmarkPose:
    """Return a refined pose with the evidence for it."""
    query, matches, fit, best = answer.query, answer.matches, answer.fit, answer.best
    seen = answer.seen
    data, by_descriptors = (
        seen.observed(found).without_motion(fit.T_world_rig, fit.motion).corrected(fit.calibration)
        for found in (answer.correspondences, matches)
    )
    off = by_descriptors.residuals(fit.T_world_rig)
    agreeing = int((torch.linalg.vector_norm(off, dim=-1) <= query.threshold).sum())
    visible, chance = answer.visible_and_by_chance()
    evidence = MatchEvidence(
        len(matches), agreeing, log10_agreement(query, matches, agreeing), chance, visible,
        sum(len(image.keypoints) for image in query.images),
    )  # fmt: skip
    pose = landmark_pose(
        fit, data, query.landmarks, evidence, answer.correspondences, query.pixels(answer.correspondences),
        _spread(query, answer.correspondences), answer.posterior.doubt_of_motion, CameraDoubt.of(answer.posterior),
    )  # fmt: skip
    calibration = fit.calibration if best.hypothesis.whose is Whose.ESTIMATED else best.taken
    return replace(pose, calibration=calibration, intrinsics=best.hypothesis.camera, guided=answer)


def landmark_pose(
    fit: ReprojectionFit, data: ObservedPoints, landmarks: LandmarkMap, evidence: MatchEvidence,
    correspondences: LandmarkMatches, pixels: Float[Tensor, "m 2"], spread: float,
    doubt_of_motion: Float[Tensor, "6 6"], doubt: CameraDoubt,
) -> LandmarkPose:  # fmt: skip
    """Return a pose by landmarks with the given intrinsics; ``data`` are its correspondences without the camera's motion."""
    T = fit.T_world_rig
    return LandmarkPose(
        **vars(evidence),
        T_world_camera=T,
        covariance=fit.covariance + doubt_of_motion + landmarks.pose_covariance,
        map_covariance=landmarks.pose_covariance,
        noise=fit.noise,
        correspondences=correspondences,
        residuals=data.residuals(T),
        normalized_residuals=data.normalized_residuals(T, fit.noise),
        pixels=pixels,
        spread=spread,
        noise_ratio=fit.noise / landmarks.noise,
        distance=median_distance(data, T),
        calibration=GIVEN,
        calibration_deviations=fit.calibration_deviations,
        motion=fit.motion,
        motion_covariance=fit.covariance_by_motion + doubt_of_motion,
        doubt=doubt,
        intrinsics=None,
        depth_scale=depth_scale(data, T),
    )


def median_distance(data: ObservedPoints, T_world_rig: SE3) -> float:
    """Return the median depth of the points in the cameras that observed them, metres."""
    return float(data.in_camera(T_world_rig)[:, 2].median())


def depth_scale(data: ObservedPoints, T_world_rig: SE3) -> float | None:
    """Return the factor that corrects measured depth; None if too few depths were measured."""
    known = data.depth > 0
    if int(known.sum()) < MIN_MATCHES:
        return None
    return float((data.in_camera(T_world_rig)[known, 2] / data.depth[known]).median())


def log10_agreement(query: LandmarkQuery, matches: LandmarkMatches, agreeing: int) -> float:
    """Return log10 of the number of false alarms if ``agreeing`` of ``matches`` are inliers."""
    return log10_nfa(len(matches), agreeing, probability_within(query.threshold, query.images[-1].intrinsics))


def probability_within(radius: float, camera: Intrinsics) -> float:
    """Return the probability that a wrong match, uniformly distributed in the image, is within ``radius`` pixels of a point."""
    return min(0.5, math.pi * radius**2 / (camera.width * camera.height))


def cell_numbers(pixels: Float[Tensor, "m 2"], camera: Intrinsics) -> Int[Tensor, "m"]:
    """Return the number of the grid cell of the image in which each pixel lies."""
    size = torch.tensor([camera.width, camera.height])
    column, row = (pixels / size * CELLS).long().clamp(0, CELLS - 1).unbind(-1)
    return row * CELLS + column


def share_of_cells(pixels: Float[Tensor, "m 2"], camera: Intrinsics) -> float:
    """Return the fraction of the image's cells that contain any of the pixels."""
    return len(cell_numbers(pixels, camera).unique()) / CELLS**2


def _spread(query: LandmarkQuery, found: LandmarkMatches) -> float:
    """Return the fraction of an image's cells that contain a correspondence, averaged over the views."""
    shares, pixels = [], query.pixels(found)
    for number, image in enumerate(query.images):
        shares.append(share_of_cells(pixels[found.view == number], image.intrinsics))
    return sum(shares) / len(shares)
