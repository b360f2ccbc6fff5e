"""Tracks: keypoints of several images that show one point of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.mapping.features import Keypoints, squared_distances
from bidnerf_core.se3 import SE3

BAND = 2.0
"""Pixels from the epipolar line within which the partner of a keypoint is sought."""
RATIO = 0.95
"""Distance of the descriptors as a share of that to the next best of all keypoints of the image, at most."""
RATIO_IN_BAND = 0.85
"""The same share, of the next best one near the epipolar line."""
APART = 4.0
"""Pixels from which on two keypoints of an image are different ones: SIFT gives one for each dominant orientation."""


@dataclass(frozen=True, eq=False)
class PosedKeypoints:
    """Keypoints of an image without its distortion, and where its camera is."""

    keypoints: Keypoints
    rays: Float[Tensor, "n 3"]  # on the plane z = 1 of the camera, float64
    focal: float  # pixels
    T_world_camera: SE3  # float64


@dataclass(frozen=True, eq=False)
class Matches:
    """Keypoints of two images that look alike and lie on one another's epipolar lines."""

    pairs: Int[Tensor, "p 2"]
    ambiguity: Float[Tensor, "p"]  # distance of the descriptors as a share of that to the next best


def epipolar_matches(a: PosedKeypoints, b: PosedKeypoints) -> Matches:
    """Keypoints of ``a`` and ``b`` that are one another's best partner near the epipolar lines.

    A match must stand out among all keypoints of ``b`` as well: what resembles many of them is on the line by chance.
    """
    if not len(a.keypoints) or not len(b.keypoints):
        return Matches(torch.zeros((0, 2), dtype=torch.long), torch.zeros(0))
    distance = squared_distances(a.keypoints.descriptors, b.keypoints.descriptors)
    banded = torch.where(_off_line(a, b) <= BAND, distance, torch.inf)
    best, partner = banded.min(dim=1)
    mutual = banded.argmin(dim=0)[partner] == torch.arange(len(partner))
    rows = (mutual & best.isfinite()).nonzero()[:, 0]
    best, partner = best[rows], partner[rows]
    next_best = _next_best(distance[rows], partner, b.keypoints.pixels)
    next_in_band = _next_best(banded[rows], partner, b.keypoints.pixels)
    good = (best < RATIO_IN_BAND**2 * next_in_band) & (best < RATIO**2 * next_best)
    ambiguity = (best / next_best.clamp(min=1)).sqrt()
    return Matches(torch.stack([rows, partner], dim=-1)[good], ambiguity[good])


def _next_best(
    distance: Float[Tensor, "r n"], partner: Int[Tensor, "r"], pixels: Float[Tensor, "n 2"]
) -> Float[Tensor, "r"]:
    """Least squared distance to a keypoint elsewhere in the image than the partner."""
    near = torch.cdist(pixels[partner], pixels) < APART
    return torch.where(near, torch.inf, distance).amin(dim=1)


def _off_line(a: PosedKeypoints, b: PosedKeypoints) -> Float[Tensor, "n m"]:
    """Pixels between each keypoint of ``b`` and the epipolar half-line of each of ``a``.

    It begins at the image of the infinitely far point of the ray. Between cameras at one place there is nothing but that
    beginning.
    """
    T_b_a = b.T_world_camera.inverse() @ a.T_world_camera
    rays, base = T_b_a.rotate(a.rays), T_b_a.translation
    z = rays[:, 2:].abs().clamp(min=1e-9)
    start = rays[:, :2] / z * rays[:, 2:].sign()
    step = (base[:2] - base[2] * start) * rays[:, 2:].sign()  # where the image moves as the point comes nearer
    size = torch.linalg.vector_norm(step, dim=-1, keepdim=True)
    forward = step / size.clamp(min=1e-300)
    sideways = torch.stack([-forward[:, 1], forward[:, 0]], dim=-1)
    along, across = (
        (axis @ b.rays[:, :2].mT - (axis * start).sum(-1, keepdim=True)) for axis in (forward, sideways)
    )
    # A ray that points behind the other camera has no beginning in its image; all of the line stays.
    beyond = (along < 0) & (rays[:, 2:] > 0)
    away = torch.where(beyond, torch.hypot(along, across), across.abs())
    if float(torch.linalg.vector_norm(base)) < 1e-12:
        away = torch.cdist(start, b.rays[:, :2])
    return away * b.focal


def joined(matches: Sequence[tuple[int, int, Matches]], sizes: Sequence[int]) -> Int[Tensor, "m"]:
    """Join matches (image, image, keypoints) into tracks: the track of each keypoint, in the numbering of all images.

    The least ambiguous matches come first, and one that would bring two keypoints of an image together is left out: a
    single wrong match would otherwise spoil two good tracks. ``sizes`` are the numbers of the keypoints of the images.
    """
    first = np.concatenate([[0], np.cumsum(sizes)])
    ends = np.concatenate([np.zeros((0, 2), np.int64)] + [m.pairs.numpy() + first[[i, j]] for i, j, m in matches])
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
    """The representative of a set (union-find with path halving, Tarjan and van Leeuwen 1984)."""
    while parent[number] != number:
        parent[number] = parent[parent[number]]
        number = parent[number]
    return number
