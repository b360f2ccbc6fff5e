"""Agreement of a model with the matched pairs of photos from which it was reconstructed.

Places that look alike, such as the doors of a corridor, can be taken for one place. The model is then folded, although its
points project where they should. It contradicts other pairs of photos, whose many matches cannot be due to chance.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def agreement(model: Any, database: Any, pycolmap: Any) -> tuple[int, int]:
    """Compare the verified pairs of a database with the poses and cameras of a model.

    Returns the number of pairs of registered photos with at least a hundred verified matches, since pairs of different places
    with repeated details have up to 80, and the number of those that contradict the model's poses: fewer than half of their
    matches are within four pixels of their epipolar lines, in the photos in which keypoints were found.
    """
    placed, keypoints = set(model.reg_image_ids()), dict[int, np.ndarray]()
    pairs = contradicting = 0
    for pair, geometry in zip(*database.read_two_view_geometries(), strict=True):
        i, j = pycolmap.pair_id_to_image_pair(pair)
        if i not in placed or j not in placed or len(geometry.inlier_matches) < 100:
            continue
        rays = []
        for number, column in ((i, 0), (j, 1)):
            if number not in keypoints:
                keypoints[number] = database.read_keypoints(number)[:, :2].astype(np.float64)
            camera = model.camera(model.image(number).camera_id)
            seen = camera.cam_from_img(keypoints[number][geometry.inlier_matches[:, column]])
            rays.append(np.column_stack([seen, np.ones(len(seen))]))
        T = (model.image(j).cam_from_world() * model.image(i).cam_from_world().inverse()).matrix()
        t = T[:, 3] / max(np.linalg.norm(T[:, 3]), 1e-12)
        lines = np.cross(t, rays[0] @ T[:, :3].T)
        away = np.abs((lines * rays[1]).sum(-1)) / np.linalg.norm(lines[:, :2], axis=-1).clip(1e-12)
        pairs += 1
        contradicting += int(np.mean(away * camera.mean_focal_length() < 4) < 0.5)
    return pairs, contradicting
