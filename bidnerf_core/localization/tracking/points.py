"""Points of the world that are followed from image to image, and the pose that they determine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.camera.rolling_shutter import STILL, MotionPrior, exposure_times, transposed_exposure_times
from bidnerf_core.frames.frame import Frame
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.landmarks.consensus import sample_consensus
from bidnerf_core.localization.landmarks.hypotheses import (
    Hypothesis,
    Motion,
    Posterior,
    camera_hypotheses,
    posterior,
    share_moving,
)
from bidnerf_core.mapping.geometry.calibration import GIVEN
from bidnerf_core.mapping.geometry.observations import ObservedPoints
from bidnerf_core.mapping.geometry.resection import ReprojectionFit, resect
from bidnerf_core.mapping.landmarks.keypoint_depth import measured_depth
from bidnerf_core.mapping.landmarks.landmark_map import LandmarkMap

LEAST_FOLLOWED = 6
"""Least number of points from which a pose is estimated."""
INLIER = 3.0
"""Largest reprojection error of an inlier, in standard deviations along both axes together."""
MAJORITY = 0.7
"""Share of inliers below which the robust fit is not relied upon, and a sample consensus is tried."""
TRACKED_STEPS = 1
"""Steps of the fits that judge a motion in a tracked frame: they start so close by that linear algebra does the rest."""
CAMERAS = camera_hypotheses([])
"""Hypotheses about the camera of an image; ``CAMERAS[:1]`` is that its intrinsics are right."""
FRESH = -1
"""Landmark number of points that are not landmarks."""


@dataclass(frozen=True, eq=False)
class FollowedPoints:
    """Points in an image, and where they are in the world; all tensors are on the CPU."""

    pixels: Float[Tensor, "m 2"]  # (u, v) in the last image
    positions: Float[Tensor, "m 3"]  # metres, world; float64
    deviations: Float[Tensor, "m 2"]  # metres, across and along ``directions``; float64
    directions: Float[Tensor, "m 3"]  # unit, world; float64
    landmark: Int[Tensor, "m"]  # its number in the map; FRESH for points that were measured in an image

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
        """Return where the points appear from a pose; their present pixels where they would lie behind the camera."""
        pixels = camera.project(T_world_camera.inverse().apply(self.positions)).float()
        return torch.where(pixels.isfinite().all(-1, keepdim=True), pixels, self.pixels)

    def observed(self, frame: Frame) -> ObservedPoints:
        """Return the points as the input of a pose solver, seen in ``frame``."""
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
            transposed_exposure_times(self.pixels, camera),
        )


@dataclass(frozen=True, eq=False)
class PointFit:
    """The pose that points determine, and which of them agree with it."""

    fit: ReprojectionFit
    data: ObservedPoints
    inliers: Bool[Tensor, "m"]
    judged: Posterior | None = None  # what explains the image, with the given intrinsics as the best

    @property
    def T_world_camera(self) -> SE3:
        return self.fit.T_world_rig

    @property
    def moves(self) -> bool:
        """Whether the camera moved while its rows were exposed, as the fit has it."""
        return bool(self.fit.motion.any())

    @property
    def still_data(self) -> ObservedPoints:
        """The points as a camera at rest at the pose would have observed them."""
        return self.data.without_motion(self.fit.T_world_rig, self.fit.motion)

    @property
    def doubt_of_motion(self) -> Float[Tensor, "6 6"]:
        """What the doubt about a motion between rows adds to the covariance of the pose."""
        return torch.zeros_like(self.fit.covariance) if self.judged is None else self.judged.doubt_of_motion

    @property
    def share(self) -> float:
        return float(self.inliers.float().mean()) if len(self.inliers) else 0.0

    def within(self, threshold: float) -> int:
        """Return how many points have a reprojection error of at most ``threshold`` pixels."""
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
    """Return the pose that the points in one camera determine, from a start; None if they are too few.

    ``noise`` (pixels) is a first guess at that of the observations, ``correlation`` the number of them that count as one. Where
    most points do not agree with the robust fit, a consensus of samples within ``threshold`` pixels replaces the start. ``moves``:
    whether the camera is taken to have moved while its rows were exposed, until ``with_motion`` judges that.
    """
    if len(data) < LEAST_FOLLOWED:
        return None
    near = _nearby(data, start, threshold)
    motion = MotionPrior.usual(float(data.in_camera(near)[:, 2].median())) if moves else STILL
    fit = resect(data, near, noise, correlation=correlation, motion=motion)
    found = PointFit(fit, data, _inliers(data, fit))
    if found.share >= MAJORITY and found.fit.noise <= threshold:
        return found
    consensus = sample_consensus(data, torch.zeros(len(data), dtype=torch.long), threshold, seed=0)
    if consensus is None or int(consensus.inliers.sum()) < LEAST_FOLLOWED:
        return found
    better = resect(data[consensus.inliers], consensus.T_world_rig, threshold / 2, correlation=correlation)
    other = PointFit(better, data, _inliers(data, better))
    return other if other.within(threshold) > found.within(threshold) else found


def with_motion(found: PointFit, landmarks: LandmarkMap, which: Sequence[Hypothesis] = CAMERAS) -> PointFit:
    """Return a fit with the more probable of a motion while the rows were exposed and none, and with what is left of doubt.

    ``which``: the hypotheses about the camera that are judged along with the motion.
    """
    inliers = found.data[found.inliers]
    if not len(inliers):
        return found
    correlation = landmarks.correlation_of(len(inliers))
    judged = posterior(
        inliers, found.T_world_camera, found.fit.noise, which, correlation, GIVEN,
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
    """Return the pose of least robust reprojection error, without its covariance: a start that costs next to nothing."""
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
