"""Tracks: keypoints of several images that show one point of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.camera.rolling_shutter import AT_REST
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.mapping.landmarks.features import Keypoints, squared_distances

EPIPOLAR_BAND = 2.0
"""Largest distance (pixels) of a match from the epipolar line."""
TRACK_RATIO = 0.95
"""Largest ratio of a match's descriptor distance to that of the next best among all keypoints of the image."""
RATIO_IN_BAND = 0.85
"""Largest ratio of a match's descriptor distance to that of the next best near the epipolar line."""
DUPLICATE_DISTANCE = 4.0
"""Distance (pixels) below which keypoints are duplicates: SIFT returns one for each dominant orientation."""
LEAST_BASELINE = 1e-12
"""Distance (metres) between two cameras below which epipolar lines are undefined."""


@dataclass(frozen=True, eq=False)
class PosedKeypoints:
    """The keypoints of an image, as undistorted rays, and the pose of its camera."""

    keypoints: Keypoints
    rays: Float[Tensor, "n 3"]  # on the plane z = 1 of the camera, float64
    focal: float  # pixels
    T_world_camera: SE3  # float64; of the middle row
    exposure_times: Float[Tensor, "n"]  # of the keypoints, see ``rolling_shutter``, float64
    motion: Float[Tensor, "6"] = AT_REST  # while the rows were exposed; epipolar lines ignore it


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of keypoints of two images that look alike and lie on each other's epipolar lines."""

    pairs: Int[Tensor, "p 2"]
    ambiguity: Float[Tensor, "p"]  # ratio of the descriptor distance to that of the next best


def epipolar_matches(a: PosedKeypoints, b: PosedKeypoints) -> Matches:
    """Return the pairs of keypoints of ``a`` and ``b`` that are mutual nearest neighbours near the epipolar lines.

    A match must also pass the ratio test among all keypoints of ``b``, because a keypoint that resembles many of them finds
    one near the line by chance.
    """
    if not len(a.keypoints) or not len(b.keypoints):
        return Matches(torch.zeros((0, 2), dtype=torch.long), torch.zeros(0))
    distance = squared_distances(a.keypoints.descriptors, b.keypoints.descriptors)
    banded = distance.masked_fill(~_on_line(a, b), torch.inf)
    best, partner = banded.min(dim=1)
    mutual = banded.argmin(dim=0)[partner] == torch.arange(len(partner))
    rows = (mutual & best.isfinite()).nonzero()[:, 0]
    best, partner = best[rows], partner[rows]
    near = torch.cdist(b.keypoints.pixels[partner], b.keypoints.pixels) < DUPLICATE_DISTANCE
    next_best = distance[rows].masked_fill(near, torch.inf).amin(dim=1)
    next_in_band = banded[rows].masked_fill(near, torch.inf).amin(dim=1)
    good = (best < RATIO_IN_BAND**2 * next_in_band) & (best < TRACK_RATIO**2 * next_best)
    ambiguity = (best / next_best.clamp(min=1)).sqrt()
    return Matches(torch.stack([rows, partner], dim=-1)[good], ambiguity[good])


def _on_line(a: PosedKeypoints, b: PosedKeypoints) -> Bool[Tensor, "n m"]:
    """Return whether each keypoint of ``b`` lies near the epipolar half-line of each keypoint of ``a``.

    The half-line begins at the image of the ray's point at infinity. If the cameras are at the same place, it reduces to
    that point.
    """
    T_b_a = b.T_world_camera.inverse() @ a.T_world_camera
    rays, base = T_b_a.rotate(a.rays), T_b_a.translation
    front = rays[:, 2:].sign()
    start = rays[:, :2] / rays[:, 2:].abs().clamp(min=1e-9) * front
    step = (base[:2] - base[2] * start) * front  # where the image moves as the point comes nearer
    size = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
    forward = step / size.clamp(min=1e-300)
    sideways = torch.stack([-forward[:, 1], forward[:, 0]], dim=-1)
    seen = torch.cat([b.rays[:, :2], torch.ones_like(b.rays[:, :1])], dim=-1).float().mT
    band = EPIPOLAR_BAND / b.focal
    if float(torch.linalg.vector_norm(base)) < LEAST_BASELINE:
        return torch.cdist(start.float(), seen[:2].mT) <= band
    across, along = (
        torch.cat([axis, -(axis * start).sum(-1, keepdim=True)], dim=-1).float() @ seen
        for axis in (sideways, forward)
    )
    # The point at infinity of a ray that points behind the other camera has no image, so the whole line is admitted.
    least = torch.where(front > 0, -band, -torch.inf).float()
    return (across.abs_() <= band) & (along >= least)


def joined_tracks(matches: Sequence[tuple[int, int, Matches]], sizes: Sequence[int]) -> Int[Tensor, "m"]:
    """Join matches (image, image, keypoints) into tracks and return the track of each keypoint, numbered across all images.

    The least ambiguous matches are joined first. A match that would put two keypoints of one image into the same track is
    left out, because a single wrong match would spoil two good tracks. ``sizes`` are the numbers of keypoints per image.
    """
    first = np.concatenate([[0], np.cumsum(sizes)])
    ends = np.concatenate(
        [np.zeros((0, 2), np.int64)] + [m.pairs.numpy() + first[[i, j]] for i, j, m in matches]
    )
    ambiguity = np.concatenate([np.zeros(0)] + [m.ambiguity.numpy() for _, _, m in matches])
    parent = list(range(first[-1]))
    images = [{image} for image, size in enumerate(sizes) for _ in range(size)]
    for a, b in ends[np.argsort(ambiguity, kind="stable")].tolist():
        small, large = sorted((_root(parent, a), _root(parent, b)), key=lambda root: len(images[root]))
        if small != large and images[small].isdisjoint(images[large]):
            parent[small] = large
            images[large] |= images[small]
    return torch.tensor([_root(parent, number) for number in range(first[-1])], dtype=torch.long)


def _root(parent: list[int], number: int) -> int:
    """Return the representative of a set (union-find with path halving, Tarjan and van Leeuwen 1984)."""
    while parent[number] != number:
        parent[number] = parent[parent[number]]
        number = parent[number]
    return number
