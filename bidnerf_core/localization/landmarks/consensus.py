"""Initial pose from matches that are mostly outliers, by poselib's minimal solvers in LO-RANSAC.

The solver is P3P for one camera (Persson and Nordberg 2018), generalized P3P for several with known relative poses (Kukelova et
al. 2016), and P4Pf for an unknown focal length. poselib provides P4Pf without a RANSAC loop, so the loop is here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import poselib
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import GIVEN, Calibration, ObservedPoints

SUCCESS = 0.9999
"""RANSAC stops once a sample without outliers has been drawn with this probability."""
LEAST_DRAWS, MOST_DRAWS = 50, 20_000
MOST_DRAWS_WITH_FOCAL = 1500
"""Fewer draws are allowed because each takes hundreds of microseconds."""
FOCAL_RANGE = (0.2, 5.0)
"""Range of the focal length, in multiples of the given one."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose and its inliers."""

    T_world_rig: SE3
    inliers: Bool[Tensor, "m"]
    draws: int
    calibration: Calibration = GIVEN


def sample_consensus(
    data: ObservedPoints, view: Int[Tensor, "m"], threshold: float, seed: int
) -> Candidate | None:
    """Return the pose with the most inliers within ``threshold`` pixels; None if there are too few matches or no solution.

    The matches in ``data`` must be ordered from the most to the least reliable. For a rig, each camera is also tried alone,
    because the generalized solver is unstable if the camera centres almost coincide.
    """
    views = view.unique().tolist()
    found = [_single(data, (view == v).nonzero()[:, 0], threshold, seed) for v in views]
    if len(views) > 1:
        found.append(_generalized(data, [(view == v).nonzero()[:, 0] for v in views], threshold, seed))
    hypotheses = [_scored(data, T, threshold, draws) for T, draws in filter(None, found)]
    return max(hypotheses, key=lambda h: int(h.inliers.sum()), default=None)


def _scored(data: ObservedPoints, T: SE3, threshold: float, draws: int) -> Candidate:
    within = torch.linalg.vector_norm(data.residuals(T), dim=-1) <= threshold
    return Candidate(T, within, draws)


def _options(threshold: float, seed: int) -> dict[str, object]:
    return {
        "max_reproj_error": threshold, "seed": seed, "success_prob": SUCCESS, "progressive_sampling": True,
        "min_iterations": LEAST_DRAWS, "max_iterations": MOST_DRAWS, "max_prosac_iterations": MOST_DRAWS,
    }  # fmt: skip


def _camera(focal: float) -> dict[str, object]:
    """Return poselib's description of a pinhole camera with its principal point at the origin."""
    return {"model": "SIMPLE_PINHOLE", "width": 0, "height": 0, "params": [focal, 0.0, 0.0]}


def _single(data: ObservedPoints, index: Tensor, threshold: float, seed: int) -> tuple[SE3, int] | None:
    if len(index) < 4:
        return None
    part, focal = data[index], float(data.focal[index[0]])
    pose, info = poselib.estimate_absolute_pose(
        (part.image * focal).numpy(), part.points.numpy(), _camera(focal), _options(threshold, seed), {}
    )
    T_camera_rig = SE3(part.rotation[0], part.translation[0])
    T = _transform(pose)
    return (T.inverse() @ T_camera_rig, int(info["iterations"])) if _sound(T) else None


def _generalized(
    data: ObservedPoints, parts: list[Tensor], threshold: float, seed: int
) -> tuple[SE3, int] | None:
    pixels = [(data.image[index] * data.focal[index, None]).numpy() for index in parts]
    points = [data.points[index].numpy() for index in parts]
    cameras = [_camera(float(data.focal[index[0]])) for index in parts]
    poses = [_camera_pose(SE3(data.rotation[index[0]], data.translation[index[0]])) for index in parts]
    if sum(map(len, pixels)) < 4:
        return None
    options = _options(threshold, seed) | {"progressive_sampling": False}
    pose, info = poselib.estimate_generalized_absolute_pose(pixels, points, poses, cameras, options, {})
    T_rig_world = _transform(pose)
    return (T_rig_world.inverse(), int(info["iterations"])) if _sound(T_rig_world) else None


def focal_consensus(data: ObservedPoints, threshold: float, seed: int) -> Candidate | None:
    """Return the pose and focal length of one camera with the most inliers within ``threshold`` pixels, or None.

    The matches in ``data`` must be ordered from the most to the least reliable. The focal length is searched within
    ``FOCAL_RANGE`` of the given one; the principal point is assumed to be known.
    """
    if len(data) < 5:
        return None
    random = np.random.default_rng(seed)
    pixels, points = (data.image * data.focal[:, None]).numpy(), data.points.numpy()
    given, best, needed, draws = float(data.focal[0]), None, MOST_DRAWS_WITH_FOCAL, 0
    while draws < needed:
        draws += 1
        pool = min(len(points), max(20, len(points) * draws // 200))  # PROSAC: the most reliable ones first
        sample = random.choice(pool, 4, replace=False)
        for pose, focal in zip(*poselib.p4pf(pixels[sample], points[sample], True), strict=True):
            if not FOCAL_RANGE[0] <= focal / given <= FOCAL_RANGE[1]:
                continue
            off = np.linalg.norm(_projected(pose, points) * focal - pixels, axis=1)
            within = off <= threshold
            if best is None or within.sum() > best[2].sum():
                best = (pose, focal / given, within)
                needed = min(needed, _draws_needed(float(within.mean())))
    if best is None or not _sound(_transform(best[0])):
        return None
    T_camera_rig = SE3(data.rotation[0], data.translation[0])
    T = _transform(best[0]).inverse() @ T_camera_rig
    return Candidate(T, torch.from_numpy(best[2]), draws, Calibration(log_focal=math.log(best[1])))


def _projected(pose: poselib.CameraPose, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 2"]:
    local = points @ np.asarray(pose.R).T + np.asarray(pose.t).reshape(3)
    return np.where(local[:, 2:] > 0, local[:, :2] / np.where(local[:, 2:] > 0, local[:, 2:], 1), np.inf)


def _draws_needed(inliers: float) -> int:
    """Return the number of samples of four among which one most likely has no outlier (Fischler and Bolles 1981)."""
    clean = min(max(inliers, 1e-3) ** 4, 1 - 1e-9)
    return max(LEAST_DRAWS, int(3 * np.log(1 - SUCCESS) / np.log1p(-clean)))


def _transform(pose: poselib.CameraPose) -> SE3:
    rotation = torch.from_numpy(np.array(pose.R, dtype=np.float64))
    return SE3(rotation, torch.from_numpy(np.array(pose.t, dtype=np.float64).reshape(3)))


def _camera_pose(T_camera_rig: SE3) -> poselib.CameraPose:
    pose = poselib.CameraPose()
    pose.R = T_camera_rig.rotation.numpy()
    pose.t = T_camera_rig.translation.numpy()
    return pose


def _sound(T: SE3) -> bool:
    return bool(T.is_rigid())
