"""Camera poses from SIFT matches with triangulated points, by pycolmap and by OpenCV: the usual minimal solution.

Each keypoint of the query is compared with all descriptors of all points, and the nearest point is taken where it passes
Lowe's ratio test against the second nearest point. Poses come from RANSAC and a refinement on its inliers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from sift_points import SiftDetector, SiftPoints, colmap_camera

from bidnerf_core.camera.intrinsics import Intrinsics
from bidnerf_core.frames.frame import Frame

RATIO = 0.8
"""Largest ratio of the distances to the nearest and to the second nearest descriptor."""
CANDIDATES = 30
"""Number of nearest descriptors that are searched for the second nearest point."""
FEWEST_INLIERS = 15
"""Minimum number of inliers of a pose that counts as found."""
OPENCV_TRIALS, OPENCV_CONFIDENCE = 10_000, 0.9999
"""OpenCV's defaults of 100 trials and 99 % are too low for matches with many outliers; pycolmap's are about as here."""
OPENCV_ERROR = 2.0
"""Largest reprojection error (pixels) of an inlier; of 2, 4 and OpenCV's default 8, the best on the frames for tuning."""


@dataclass(frozen=True, eq=False)
class PnpResult:
    """A pose and the number of its inliers."""

    T_world_camera: NDArray[np.float64]  # 4x4
    inliers: int


class SiftMatcher:
    """Matches images with points by brute force."""

    def __init__(self, points: SiftPoints) -> None:
        self.points, self.detector = points, SiftDetector()
        self.descriptors = _unit(points.descriptors)
        lengths = np.diff(points.first, append=len(points.descriptors))
        self.owner = torch.from_numpy(np.repeat(np.arange(len(points)), lengths))

    def __call__(self, frame: Frame) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the pixels (m, 2) of the keypoints that match and the points (m, 3) that they show."""
        keypoints, found = self.detector(frame)
        if not len(keypoints) or len(self.points) < 2:
            return np.zeros((0, 2)), np.zeros((0, 3))
        cosines = _unit(found) @ self.descriptors.T
        nearest = cosines.topk(min(CANDIDATES, len(self.owner)), dim=1)
        squared = (2 - 2 * nearest.values).clamp(min=0)  # distances of unit vectors
        point = self.owner[nearest.indices]
        other = squared.masked_fill(point == point[:, :1], torch.inf).amin(dim=1)
        second = torch.minimum(
            other, squared[:, -1]
        )  # if all belong to one point, other points are farther away than the last of these descriptors
        good = (squared[:, 0] < RATIO**2 * second).numpy()
        number = point[:, 0].numpy()[good]
        return keypoints[good, :2].astype(np.float64), self.points.positions[number]


def _unit(descriptors: NDArray[np.uint8]) -> torch.Tensor:
    """Return descriptors (n, d) as floats of unit length."""
    return torch.nn.functional.normalize(torch.tensor(descriptors).float(), dim=1)


def colmap_pnp(
    pixels: NDArray[np.float64], points: NDArray[np.float64], intrinsics: Intrinsics, seed: int
) -> PnpResult | None:
    """Estimate T_world_camera with pycolmap's LO-RANSAC and refinement, with default options."""
    import pycolmap

    pycolmap.set_random_seed(seed)
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, points, colmap_camera(intrinsics))
    if found is None:
        return None
    return PnpResult(_inverse(found["cam_from_world"].matrix()), int(found["num_inliers"]))


def opencv_pnp(
    pixels: NDArray[np.float64], points: NDArray[np.float64], intrinsics: Intrinsics, seed: int
) -> PnpResult | None:
    """Estimate T_world_camera with OpenCV's P3P in RANSAC, and refine it on the inliers."""
    if len(pixels) < 4:
        return None
    cv2.setRNGSeed(seed)
    camera = (intrinsics.matrix().numpy(), np.array(intrinsics.distortion) if intrinsics.distortion else None)
    good, turn, shift, inliers = cv2.solvePnPRansac(
        points, pixels, *camera, iterationsCount=OPENCV_TRIALS, reprojectionError=OPENCV_ERROR,
        confidence=OPENCV_CONFIDENCE, flags=cv2.SOLVEPNP_AP3P,
    )  # fmt: skip
    if not good or inliers is None:
        return None
    kept = inliers[:, 0]
    if len(kept) >= 4:
        turn, shift = cv2.solvePnPRefineLM(points[kept], pixels[kept], *camera, turn, shift)
    rotation: Any = cv2.Rodrigues(turn)[0]
    return PnpResult(_inverse(np.hstack([rotation, shift.reshape(3, 1)])), len(kept))


def _inverse(T_camera_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse (4x4) of a rigid transform (3x4)."""
    T = np.eye(4)
    T[:3, :3] = T_camera_world[:, :3].T
    T[:3, 3] = -T[:3, :3] @ T_camera_world[:, 3]
    return T
