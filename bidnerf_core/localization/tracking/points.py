"""World points tracked from image to image, and the pose that they determine."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera import STILL, Intrinsics, MotionPrior, exposure_times
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.consensus import sample_consensus
from bidnerf_core.localization.landmarks.correspondences import MIN_MATCHES
from bidnerf_core.localization.landmarks.hypotheses import (
    Motion,
    Posterior,
    camera_hypotheses,
    posterior,
    share_moving,
)
from bidnerf_core.mapping import GIVEN, LandmarkMap, ObservedPoints, ReprojectionFit, measured_depth, resect

INLIER = 3.0
"""Maximum reprojection error (norm) of an inlier, in standard deviations."""
MAJORITY = 0.7
"""Inlier fraction below which the robust fit is not trusted, and sample consensus is tried."""
TRACKED_STEPS = 1
"""Steps of the fits for the posterior of a motion in a tracked frame: the start is so close that linear algebra does the rest."""
FRESH = -1
"""Landmark number of points that are not landmarks."""


@dataclass(frozen=True, eq=False)
class FollowedPoints:
    """Points in an image and their positions in the world; all tensors are on the CPU."""

    pixels: Float[Tensor, "m 2"]  # (u, v) in the last image
    positions: Float[Tensor, "m 3"]  # metres, world; float64
    deviations: Float[Tensor, "m 2"]  # metres, across and along ``directions``; float64
    directions: Float[Tensor, "m 3"]  # unit, world; float64
    landmark: Int[Tensor, "m"]  # its number in the map; FRESH for points measured in an image

    @staticmethod
    def none() -> FollowedPoints:
        wide = torch.zeros((0, 3), dtype=torch.float64)
        return FollowedPoints(torch.zeros((0, 2)), wide, wide[:, :2], wide, torch.zeros(0, dtype=torch.long))

    @staticmethod
    def of_landmarks(
        landmarks: LandmarkMap, number: Int[Tensor, "m"], pixels: Float[Tensor, "m 2"]
    ) -> FollowedPoints:
        return FollowedPoints(
            pixels,
            landmarks.positions[number].double(),
            landmarks.deviations[number].double(),
            landmarks.directions[number].double(),
            number,
        )

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, index: Tensor) -> FollowedPoints:
        return FollowedPoints(*(getattr(self, field.name)[index] for field in fields(self)))

    def projected(self, camera: Intrinsics, T_world_camera: SE3) -> Float[Tensor, "m 2"]:
        """Return the points' projections at a pose; the current pixels of those that would be behind the camera."""
        pixels = camera.project(T_world_camera.inverse().apply(self.positions)).float()
        return torch.where(pixels.isfinite().all(-1, keepdim=True), pixels, self.pixels)

    def observed(self, frame: Frame) -> ObservedPoints:
        """Return the points and their observations in ``frame`` as input for a pose solver."""
        camera, count = frame.intrinsics, len(self)
        return ObservedPoints(
            self.positions,
            self.deviations,
            self.directions,
            camera.unproject(self.pixels.double())[:, :2],
            torch.full((count,), (camera.fx * camera.fy) ** 0.5, dtype=torch.float64),
            measured_depth(frame, self.pixels),
            torch.eye(3, dtype=torch.float64).expand(count, 3, 3),
            torch.zeros((count, 3), dtype=torch.float64),
            exposure_times(self.pixels, camera),
        )


@dataclass(frozen=True, eq=False)
class PointFit:
    """The pose that points determine, and its inliers."""

    fit: ReprojectionFit
    data: ObservedPoints
    inliers: Bool[Tensor, "m"]
    judged: Posterior | None = None  # over cameras and motions, with the given intrinsics as the best

    @property
    def T_world_camera(self) -> SE3:
        return self.fit.T_world_rig

    @property
    def moves(self) -> bool:
        """Whether the fit includes a motion of the camera during the readout."""
        return bool(self.fit.motion.any())

    @property
    def still_data(self) -> ObservedPoints:
        """The points displaced so that a static camera at the pose observes them where the moving one did."""
        return self.data.without_motion(self.fit.T_world_rig, self.fit.motion)

    @property
    def doubt_of_motion(self) -> Float[Tensor, "6 6"]:
        """Additional covariance of the pose due to uncertainty about a motion during the readout."""
        return torch.zeros_like(self.fit.covariance) if self.judged is None else self.judged.doubt_of_motion

    @property
    def share(self) -> float:
        return float(self.inliers.float().mean()) if len(self.inliers) else 0.0

    def within(self, threshold: float) -> int:
        """Return the number of points with a reprojection error of at most ``threshold`` pixels."""
        off = torch.linalg.vector_norm(self.still_data.residuals(self.T_world_camera), dim=-1)
        return int((off <= threshold).sum())


def fit_pose(
    data: ObservedPoints,
    start: SE3,
    noise: float,
    threshold: float,
    correlation: float = 1.0,
    moves: bool = False,
) -> PointFit | None:
    """Estimate the pose of one camera from points and a start; None if there are too few points.

    ``noise`` (pixels) is a first guess at that of the observations, ``correlation`` the number of them that count as one. If the
    robust fit has too few inliers, sample consensus within ``threshold`` pixels gives another start. ``moves`` is whether a motion
    during the readout is assumed until ``with_motion`` tests for it.
    """
    if len(data) < MIN_MATCHES:
        return None
    near = _nearby(data, start, threshold)
    motion = MotionPrior.usual(float(data.in_camera(near)[:, 2].median())) if moves else STILL
    fit = resect(data, near, noise, correlation=correlation, motion=motion)
    found = PointFit(fit, data, _inliers(data, fit))
    if found.share >= MAJORITY and found.fit.noise <= threshold:
        return found
    consensus = sample_consensus(data, torch.zeros(len(data), dtype=torch.long), threshold, seed=0)
    if consensus is None or int(consensus.inliers.sum()) < MIN_MATCHES:
        return found
    better = resect(data[consensus.inliers], consensus.T_world_rig, threshold / 2, correlation=correlation)
    other = PointFit(better, data, _inliers(data, better))
    return other if other.within(threshold) > found.within(threshold) else found


def with_motion(found: PointFit, landmarks: LandmarkMap, trusts_camera: bool = False) -> PointFit:
    """Return a fit with a motion during the readout if that is more probable, and with the remaining uncertainty about it.

    Hypotheses about the camera are compared along with the motion, unless its intrinsics are trusted.
    """
    cameras = camera_hypotheses([])
    inliers = found.data[found.inliers]
    if not len(inliers):
        return found
    correlation = landmarks.correlation_of(len(inliers))
    judged = posterior(
        inliers, found.T_world_camera, found.fit.noise, cameras[:1] if trusts_camera else cameras, correlation, GIVEN,
        landmarks.calibration_scatter, share_moving(landmarks), TRACKED_STEPS,
    ).with_stated  # fmt: skip
    moved = judged.best.motion is Motion.MOVING
    if moved != found.moves:
        T, noise = found.T_world_camera, found.fit.noise
        motion = MotionPrior.usual(judged.distance) if moved else STILL
        fit = resect(found.data, T, noise, correlation=correlation, motion=motion)
        found = PointFit(fit, found.data, _inliers(found.data, fit))
    return replace(found, judged=judged.with_best(judged.best, found.T_world_camera))


def _inliers(data: ObservedPoints, fit: ReprojectionFit) -> Bool[Tensor, "m"]:
    still = data.without_motion(fit.T_world_rig, fit.motion)
    off = still.normalized_residuals(fit.T_world_rig, fit.noise)
    return torch.linalg.vector_norm(off, dim=-1) <= INLIER


def _nearby(data: ObservedPoints, start: SE3, threshold: float) -> SE3:
    """Return the pose with the smallest robust reprojection error, without covariance, as a cheap start."""
    focal = float(data.focal[0])
    inverse = start.inverse()
    pose = poselib.CameraPose()
    pose.R, pose.t = inverse.rotation.numpy(), inverse.translation.numpy()
    camera = {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal, 0.0, 0.0]}
    options = {"loss_type": "CAUCHY", "loss_scale": threshold / 2}
    found, _ = poselib.refine_absolute_pose(
        np.asarray(data.image * focal), np.asarray(data.points), pose, camera, options
    )
    T = SE3(torch.from_numpy(np.array(found.R)), torch.from_numpy(np.array(found.t))).inverse()
    return T.normalized() if bool(T.is_rigid()) else start
