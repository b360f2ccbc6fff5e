"""Poses in another convention than expected: axes of other software, or inverse matrices.

Which keypoints of two images show the same point follows from the images alone (RANSAC of an essential matrix, Nistér, PAMI
2004). Poses under which most of these matches are off their epipolar lines, and would not be with other axes or as inverse
matrices, are in another convention.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.mapping import PosedKeypoints
from bidnerf_core.mapping.landmarks.features import squared_distances
from bidnerf_core.mapping.landmarks.tracks import LEAST_BASELINE, likely_pairs_of_poses

MOST_PAIRS = 40
"""Largest number of pairs of images that are examined."""
ENOUGH_PAIRS = 8
"""Least number of pairs with matches, from which the convention is judged."""
RATIO = 0.8
"""Largest ratio of a match's descriptor distance to that of the next best (Lowe 2004)."""
ENOUGH_MATCHES = 40
"""Least number of matches of a pair that agree on an essential matrix."""
MATCH_PIXELS, POSE_PIXELS = 1.0, 4.0
"""Largest distance (pixels) of a match from its epipolar line: by its own essential matrix, and by poses of any source."""
NEAR_LINES = 0.7
"""Least share of the matches of a pair near their epipolar lines, for poses that agree with it."""
FEW, MOST = 0.4, 0.7
"""Shares of the pairs with which poses agree: fewer contradict them as given, and as many support another convention."""
ALMOST_BEST = 0.9
"""Share of the best convention's pairs with which a more usual one must agree to be preferred."""


@dataclass(frozen=True)
class OtherConvention:
    """A convention in which the poses agree with the images, as they do not in the expected one."""

    axes: tuple[
        tuple[int, int, int], ...
    ]  # rows of R_given_true, the true camera's axes in the given camera's
    inverted: bool  # whether the given matrices are T_camera_world
    pairs: int  # of images with matches
    agreeing: int  # pairs with which this convention agrees
    agreeing_as_given: int

    @property
    def sentence(self) -> str:
        """What is wrong, and what to do about it."""
        found = (
            f"the poses contradict the photos: they agree with the keypoints of {self.agreeing_as_given} of {self.pairs}"
            f" pairs of photos, but of {self.agreeing} if the matrices are"
        )
        if self.inverted:
            return (
                f"{found} inverses (world to camera); invert them, and if they are then refused again, multiply each from"
                " the right by diag(1, -1, -1, 1)"
            )
        if self.axes == Y_AND_Z_REVERSED:
            return (
                f"{found} for cameras whose y and z axes are reversed (OpenCV's and COLMAP's axes where OpenGL's and"
                " Blender's are expected, or the other way round); multiply each from the right by diag(1, -1, -1, 1)"
            )
        return f"{found} for cameras with other axes: right, down and forward are {self._named_axes}"

    @property
    def _named_axes(self) -> str:
        """Where the true camera's axes point, in terms of the given camera's."""
        names = ("right", "down", "forward"), ("left", "up", "backward")
        words = []
        for column in zip(*self.axes, strict=True):
            number = next(i for i, value in enumerate(column) if value)
            words.append(names[column[number] < 0][number])
        return "the given ones' {}, {} and {}".format(*words)


Y_AND_Z_REVERSED = ((1, 0, 0), (0, -1, 0), (0, 0, -1))


def other_convention(images: Sequence[PosedKeypoints]) -> OtherConvention | None:
    """Return the convention that the poses of ``images`` follow, if it is plainly another one than expected."""
    known = [pair for i, j in _pairs(images) if (pair := _matched(images, i, j)) is not None]
    if len(known) < ENOUGH_PAIRS:
        return None
    axes = _axes()
    agreeing = torch.stack(
        [torch.cat([p.agreeing(axes, inverted) for inverted in (False, True)]) for p in known]
    )
    agreeing = agreeing.sum(0)
    best = int(agreeing.max())
    if int(agreeing[0]) > FEW * len(known) or best < MOST * len(known):
        return None
    usual = [1, len(axes), len(axes) + 1]  # y and z reversed, and both ways to invert
    number = next((n for n in usual if int(agreeing[n]) >= ALMOST_BEST * best), int(agreeing.argmax()))
    rows = tuple((int(a), int(b), int(c)) for a, b, c in axes[number % len(axes)].tolist())
    return OtherConvention(rows, number >= len(axes), len(known), int(agreeing[number]), int(agreeing[0]))


@dataclass(frozen=True, eq=False)
class _MatchedPair:
    """Two cameras, and points on the plane z = 1 that both see."""

    T_world_first: SE3
    T_world_second: SE3
    first: Float[Tensor, "m 3"]
    second: Float[Tensor, "m 3"]
    focal: float  # pixels

    def agreeing(self, axes: Float[Tensor, "a 3 3"], inverted: bool) -> Float[Tensor, "a"]:
        """Return 1 for each choice of axes with which the matches are near their epipolar lines, else 0."""
        first, second = self.T_world_first, self.T_world_second
        given = first @ second.inverse() if inverted else first.inverse() @ second
        turned = axes.mT @ given.rotation.mT @ axes  # R_second_first
        moved = -(turned @ axes.mT @ given.translation[:, None])  # of the origin, seen by the second camera
        rays = (turned @ self.first.mT).mT
        if (
            float(torch.linalg.vector_norm(given.translation)) < LEAST_BASELINE
        ):  # no lines, but the same directions
            away = torch.linalg.vector_norm(rays[..., :2] / rays[..., 2:] - self.second[:, :2], dim=-1)
        else:
            lines = torch.linalg.cross(moved.mT, rays)
            away = (lines * self.second).sum(-1) / torch.linalg.vector_norm(lines[..., :2], dim=-1)
        near = (away.abs() * self.focal <= POSE_PIXELS).double().mean(-1)
        return (near >= NEAR_LINES).double()


def _axes() -> Float[Tensor, "24 3 3"]:
    """Return the rotations that permute and reverse axes: the identity, y and z reversed, then the others."""
    found = [torch.eye(3, dtype=torch.float64), torch.tensor(Y_AND_Z_REVERSED, dtype=torch.float64)]
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = torch.zeros(3, 3, dtype=torch.float64)
            matrix[list(order), range(3)] = torch.tensor(signs, dtype=torch.float64)
            if float(torch.linalg.det(matrix)) > 0 and not any(torch.equal(matrix, other) for other in found):
                found.append(matrix)
    return torch.stack(found)


def _pairs(images: Sequence[PosedKeypoints]) -> list[tuple[int, int]]:
    """Return pairs that probably show the same things: nearby by the poses, whose axes may be wrong, or in the order given."""
    count = len(images)
    pairs = {(i, i + step) for step in (1, 3) for i in range(count - step)}
    if count > 1:
        near = likely_pairs_of_poses([image.T_world_camera for image in images], 2)
        pairs |= {(i, j) for i, j in near.tolist()}
    ordered = sorted(pairs)
    return ordered[:: max(1, -(-len(ordered) // MOST_PAIRS))]


def _matched(images: Sequence[PosedKeypoints], i: int, j: int) -> _MatchedPair | None:
    """Return the matches of two images that agree on an essential matrix; None if these are too few."""
    a, b = images[i], images[j]
    if min(len(a.keypoints), len(b.keypoints)) < ENOUGH_MATCHES:
        return None
    distance = squared_distances(a.keypoints.descriptors, b.keypoints.descriptors)
    nearest = distance.topk(2, largest=False)
    partner = nearest.indices[:, 0]
    mutual = distance.argmin(0)[partner] == torch.arange(len(partner))
    rows = (mutual & (nearest.values[:, 0] < RATIO**2 * nearest.values[:, 1])).nonzero()[:, 0]
    if len(rows) < ENOUGH_MATCHES:
        return None
    first, second, focal = a.rays[rows], b.rays[partner[rows]], min(a.focal, b.focal)
    cv2.setRNGSeed(0)
    found, mask = cv2.findEssentialMat(
        first[:, :2].numpy(), second[:, :2].numpy(), np.eye(3), cv2.RANSAC, prob=0.999, threshold=MATCH_PIXELS / focal
    )  # fmt: skip
    if found is None or len(mask) != len(rows):
        return None
    kept = torch.from_numpy(mask[:, 0].astype(bool))
    if int(kept.sum()) < ENOUGH_MATCHES:
        return None
    return _MatchedPair(a.T_world_camera, b.T_world_camera, first[kept], second[kept], focal)
