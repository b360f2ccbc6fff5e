"""Guided matching: given a pose, compare each keypoint only with the landmarks that project near it."""

from __future__ import annotations

from collections.abc import Sequence
from math import radians

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.camera import AT_REST, Intrinsics, exposure_times, moved_points
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.landmarks.correspondences import MAX_AMBIGUITY, LandmarkMatches
from bidnerf_core.mapping import GIVEN, Calibration, ImageKeypoints, LandmarkMap, paired_squared_distances

CANDIDATES = 6
"""Maximum number of landmarks that are compared with a keypoint: the nearest ones in the image."""
OBLIQUE = radians(40)
"""Maximum angle (radians) outside the cone of a landmark's viewing directions at which it is still matched."""
OCTAVES = 1.0
"""Maximum difference (octaves) between the size of a keypoint and the expected size of its landmark."""


def guided_matches(
    images: Sequence[ImageKeypoints],
    landmarks: LandmarkMap,
    T_world_rig: SE3,
    radius: float,
    most_distance: float,
    calibration: Calibration = GIVEN,
    motion: Float[Tensor, "6"] = AT_REST,
) -> LandmarkMatches:
    """Return the matches of keypoints with landmarks that project within ``radius`` pixels of them.

    ``motion`` is that of a single camera during its readout, and ``most_distance`` the maximum squared descriptor distance of a
    match.
    """
    projections = projected_landmarks(images, landmarks, T_world_rig, calibration, radius, motion)
    return LandmarkMatches.cat([found.matches(radius, most_distance) for found in projections])


def projected_landmarks(
    images: Sequence[ImageKeypoints],
    landmarks: LandmarkMap,
    T_world_rig: SE3,
    calibration: Calibration,
    margin: float,
    motion: Float[Tensor, "6"] = AT_REST,
) -> list[ProjectedLandmarks]:
    """Return the landmarks that should be visible in each image, up to ``margin`` pixels beyond its edges."""
    return [
        ProjectedLandmarks(number, image, landmarks, T_world_rig, calibration, margin, motion)
        for number, image in enumerate(images)
    ]


class ProjectedLandmarks:
    """The landmarks that should be visible in one of the query's images, with their projections."""

    def __init__(
        self,
        number: int,
        image: ImageKeypoints,
        landmarks: LandmarkMap,
        T_world_rig: SE3,
        calibration: Calibration,
        margin: float,
        motion: Float[Tensor, "6"] = AT_REST,
    ) -> None:
        self._number, self._image, self._landmarks = number, image, landmarks
        focal = image.focal * calibration.focal_factor
        T_world_camera = T_world_rig @ image.T_ref_camera
        self._index, local = _visible(image, landmarks, T_world_camera, focal, margin)
        self._pixels = calibration.pixels(local[:, :2] / local[:, 2:], image.focal)
        if bool(motion.any()):
            times = exposure_times(_image_pixels(self._pixels, image), image.intrinsics)
            local = moved_points(local, times, motion)
            self._pixels = calibration.pixels(local[:, :2] / local[:, 2:], image.focal)
        self._sizes = landmarks.sizes[self._index] * focal / local[:, 2]
        self._tree = cKDTree(self._pixels.numpy()) if len(self._pixels) else None

    def __len__(self) -> int:
        return len(self._index)

    def matches(
        self, radius: float, most_distance: float, shift: tuple[float, float] = (0.0, 0.0)
    ) -> LandmarkMatches:
        """Return matches as in ``guided_matches``; if keypoints are shifted (pixels), all matches are due to chance."""
        observed = (self._image.rays[:, :2] * self._image.focal + torch.tensor(shift)).float()
        keypoint, found = self._near(observed, radius)
        keypoints = self._image.keypoints
        alike = (self._sizes[found] / keypoints.sizes[keypoint]).log2().abs() <= OCTAVES
        keypoint, landmark = keypoint[alike], self._index[found[alike]]
        distance = paired_squared_distances(
            keypoints.descriptors, self._landmarks.descriptors, keypoint, landmark
        )
        best, ambiguity = _best(keypoint, landmark, distance, most_distance)
        number = torch.full_like(best, self._number)
        return LandmarkMatches(number, keypoint[best], landmark[best], ambiguity)

    def _near(
        self, observed: Float[Tensor, "k 2"], radius: float
    ) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
        """Return the pairs of keypoints and projections within ``radius`` (pixels) of each other, as two lists of indices."""
        if self._tree is None or not len(observed):
            return torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long)
        _, found = self._tree.query(observed.numpy(), k=CANDIDATES, distance_upper_bound=radius)
        index = torch.from_numpy(np.asarray(found, dtype=np.int64))
        rows, columns = (index < len(self._pixels)).nonzero().unbind(-1)
        return rows, index[rows, columns]


def _image_pixels(pixels: Float[Tensor, "m 2"], image: ImageKeypoints) -> Float[Tensor, "m 2"]:
    """Convert pixels relative to the principal point, at the mean focal length, to image pixels; distortion is neglected."""
    camera = image.intrinsics
    across = torch.tensor([camera.fx, camera.fy]) / image.focal
    return pixels * across + torch.tensor([camera.cx, camera.cy])


def _visible(
    image: ImageKeypoints, landmarks: LandmarkMap, T_world_camera: SE3, focal: float, margin: float
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m 3"]]:
    """Return the landmarks inside the image of a camera, seen roughly from a mapped direction, and where its frame has them.

    Those much smaller than the smallest keypoint are excluded, since there may be many beyond a wall.
    """
    found = image.keypoints.sizes
    size = float(found.min()) / (2**OCTAVES * focal) if len(found) else 0.0
    slopes = slopes_in_view(image.intrinsics, focal, margin)
    index, local = landmarks.in_view(T_world_camera, slopes, OBLIQUE, size)
    if image.hidden is None:
        return index, local
    seen = ~_hidden(image.hidden, local, image.intrinsics)
    return index[seen], local[seen]


def slopes_in_view(camera: Intrinsics, focal: float, margin: float = 0.0) -> Float[Tensor, "2"]:
    """Return the largest slopes |x / z| and |y / z| of points in view, up to ``margin`` pixels beyond the edges of the image.

    Distortion moves the edges. Too large slopes are harmless: landmarks outside match no keypoints.
    """
    half = torch.tensor([max(camera.cx, camera.width - camera.cx), max(camera.cy, camera.height - camera.cy)])
    return (1.3 * half + margin) / focal


def _hidden(
    hidden: Bool[Tensor, "h w"], local: Float[Tensor, "m 3"], camera: Intrinsics
) -> Bool[Tensor, "m"]:
    """Return a mask of the points in front of a camera that project to hidden pixels; distortion is neglected."""
    column = (local[:, 0] / local[:, 2] * camera.fx + camera.cx).floor().clamp(-1, camera.width).long()
    row = (local[:, 1] / local[:, 2] * camera.fy + camera.cy).floor().clamp(-1, camera.height).long()
    within = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return within & hidden[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]


def _best(
    keypoint: Int[Tensor, "p"], landmark: Int[Tensor, "p"], distance: Float[Tensor, "p"], most: float
) -> tuple[Int[Tensor, "m"], Float[Tensor, "m"]]:
    """Return the best pair of each keypoint that passes the ratio test, at most one per landmark, and its ambiguity."""
    order = distance.argsort(stable=True)
    order = order[keypoint[order].argsort(stable=True)]
    begins = torch.ones(len(order), dtype=torch.bool)
    begins[1:] = keypoint[order][1:] != keypoint[order][:-1]
    first = begins.nonzero()[:, 0]
    following = (first + 1).clamp(max=max(0, len(order) - 1))
    alone = (first + 1 >= len(order)) | begins[following]
    nearest = distance[order[first]]
    next_best = torch.where(alone, most / MAX_AMBIGUITY**2, distance[order[following]])
    ambiguity = (nearest / next_best.clamp(min=1)).sqrt()
    good = (nearest <= most) & (ambiguity <= MAX_AMBIGUITY)
    return _once(order[first[good]], landmark, distance, ambiguity[good])


def _once(
    chosen: Int[Tensor, "m"], landmark: Tensor, distance: Tensor, ambiguity: Tensor
) -> tuple[Int[Tensor, "k"], Float[Tensor, "k"]]:
    """Keep only the best of the pairs ``chosen`` that share a landmark."""
    order = distance[chosen].argsort(stable=True)
    order = order[landmark[chosen[order]].argsort(stable=True)]
    ids = landmark[chosen[order]]
    begins = torch.ones(len(ids), dtype=torch.bool)
    begins[1:] = ids[1:] != ids[:-1]
    kept = order[begins].sort().values
    return chosen[kept], ambiguity[kept]
