"""Agreement of a model with the matched pairs of photos from which it was reconstructed.

Places that look alike, such as the doors of a corridor, can be taken for one place. The model is then folded, although its
points project where they should. It contradicts other pairs of photos, whose many matches cannot be due to chance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

LEAST_MATCHES = 100
"""Verified matches of a pair that surely shows one place; pairs of different places with repeated details have up to 80."""
FITTING = 0.5
"""Minimum fraction of a pair's matches that must fit the model's poses for the pair to agree with the model."""
TOLERANCE = 4.0
"""Distance from the epipolar line within which a match fits the poses, in pixels of the photos in which keypoints were found."""


@dataclass(frozen=True)
class Agreement:
    """The number of pairs of registered photos with many verified matches, and of those that contradict the model's poses."""

    pairs: int
    contradicting: int


def agreement(model: Any, database: Any, pycolmap: Any) -> Agreement:
    """Compare the verified pairs of a database with the poses and cameras of a model."""
    placed, keypoints = set(model.reg_image_ids()), dict[int, np.ndarray]()
    pairs = contradicting = 0
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        i, j = pycolmap.pair_id_to_image_pair(pair)
        if i not in placed or j not in placed or len(geometry.inlier_matches) < LEAST_MATCHES:
            continue
        for number in (i, j):
            if number not in keypoints:
                keypoints[number] = database.read_keypoints(number)[:, :2].astype(np.float64)
        seen = keypoints[i][geometry.inlier_matches[:, 0]], keypoints[j][geometry.inlier_matches[:, 1]]
        pairs += 1
        fitting = _epipolar_distances(model, i, j, *seen) < TOLERANCE
        contradicting += int(np.mean(fitting) < FITTING)
    return Agreement(pairs, contradicting)


def _epipolar_distances(model: Any, i: int, j: int, in_i: np.ndarray, in_j: np.ndarray) -> np.ndarray:
    """Return the distances (pixels) of keypoints of photo ``j`` from the epipolar lines of their matches in ``i``."""
    first, second = model.image(i), model.image(j)
    camera = model.camera(second.camera_id)
    x = np.column_stack([model.camera(first.camera_id).cam_from_img(in_i), np.ones(len(in_i))])
    y = np.column_stack([camera.cam_from_img(in_j), np.ones(len(in_j))])
    T = (second.cam_from_world() * first.cam_from_world().inverse()).matrix()
    t = T[:, 3] / max(np.linalg.norm(T[:, 3]), 1e-12)
    lines = np.cross(t, x @ T[:, :3].T)
    return (
        np.abs((lines * y).sum(-1))
        / np.linalg.norm(lines[:, :2], axis=-1).clip(1e-12)
        * camera.mean_focal_length()
    )
