"""Poses in another convention than expected: axes of other software, or inverse matrices.

How the camera turned between two images follows from their keypoints alone (Nistér, An efficient solution to the five-point
relative pose problem, PAMI 2004). Poses that contradict it in most pairs, and that would agree with other axes, are in another
convention.
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

from bidnerf_core.mapping.features import squared_distances
from bidnerf_core.mapping.tracks import PosedKeypoints
from bidnerf_core.mapping.view_pairs import likely_pairs_of_poses
from bidnerf_core.se3 import SE3

MOST_PAIRS = 40
"""Largest number of pairs of images that are compared."""
ENOUGH_PAIRS = 8
"""Least number of pairs whose rotation is known, from which the convention is judged."""
RATIO = 0.8
"""Largest ratio of a match's descriptor distance to that of the next best (Lowe 2004)."""
ENOUGH_MATCHES = 40
"""Least number of matches of a pair that agree on a rotation."""
LEAST_ANGLE = 4.0
"""Least rotation, in degrees, that tells conventions apart."""
TOLERANCE, RELATIVE_TOLERANCE = 3.0, 0.25
"""Largest error of a rotation that agrees: degrees, or a share of the rotation if that is larger."""
FEW, MOST = 0.4, 0.7
"""Shares of the pairs that agree: fewer contradict the poses as given, and as many support another convention."""
SEEN_PIXELS = 1.0
"""Largest distance (pixels) of a match from its epipolar line."""


@dataclass(frozen=True)
class OtherConvention:
    """A convention in which the poses agree with the images, as they do not in the expected one."""

    axes: tuple[
        tuple[int, int, int], ...
    ]  # rows of R_given_true, the true camera's axes in the given camera's
    inverted: bool  # whether the given matrices are T_camera_world
    pairs: int  # of images whose rotation is known
    agreeing: int  # pairs with which this convention agrees
    agreeing_as_given: int

    @property
    def sentence(self) -> str:
        """What is wrong, and what to do about it."""
        found = (
            f"the poses contradict the photos: the camera turned as they say between {self.agreeing_as_given} of {self.pairs}"
            f" pairs of photos, but between {self.agreeing} if the matrices are"
        )
        if self.inverted:
            return f"{found} inverses (world to camera); invert them"
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
    known = _rotations(images)
    if len(known) < ENOUGH_PAIRS:
        return None
    first, second = (torch.tensor([pair[k] for pair in known]) for k in (0, 1))
    seen = torch.stack([pair[2] for pair in known])
    rotation = torch.stack([image.T_world_camera.rotation for image in images])
    axes = _axes()
    agreeing = [
        _agreeing(R[second].mT @ R[first], seen, axes) for R in (rotation, rotation.mT)
    ]  # as given, and inverted
    as_given = int(agreeing[0][0])
    inverted = bool(agreeing[1].max() > agreeing[0].max())
    best = int(agreeing[inverted].argmax())
    most = int(agreeing[inverted][best])
    if as_given > FEW * len(known) or most < MOST * len(known):
        return None
    rows = tuple((int(a), int(b), int(c)) for a, b, c in axes[best].tolist())
    return OtherConvention(rows, inverted, len(known), most, as_given)


def _agreeing(
    turned: Float[Tensor, "p 3 3"], seen: Float[Tensor, "p 3 3"], axes: Float[Tensor, "a 3 3"]
) -> Float[Tensor, "a"]:
    """Return, for each choice of axes, the number of pairs between which the camera turned as seen."""
    expected = axes[:, None].mT @ turned @ axes[:, None]
    error, angle = _angle(expected.mT @ seen), _angle(seen)
    return (error <= (RELATIVE_TOLERANCE * angle).clamp(min=TOLERANCE)).double().sum(1)


def _angle(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Return the angle (degrees) of a rotation."""
    return torch.linalg.vector_norm(
        SE3(rotation, rotation.new_zeros(rotation.shape[:-1])).log()[..., 3:], dim=-1
    ).rad2deg()


def _axes() -> Float[Tensor, "24 3 3"]:
    """Return the rotations that permute and reverse axes, the identity first."""
    found = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = torch.zeros(3, 3, dtype=torch.float64)
            matrix[list(order), range(3)] = torch.tensor(signs, dtype=torch.float64)
            if float(torch.linalg.det(matrix)) > 0:
                found.append(matrix)
    return torch.stack(found)


def _rotations(images: Sequence[PosedKeypoints]) -> list[tuple[int, int, Float[Tensor, "3 3"]]]:
    """Return pairs of images and R_second_first, which follows from their keypoints, where it tells conventions apart."""
    found = []
    for i, j in _pairs(images):
        rotation = _rotation(images[i], images[j])
        if rotation is not None and float(_angle(rotation)) >= LEAST_ANGLE:
            found.append((i, j, rotation))
    return found


def _pairs(images: Sequence[PosedKeypoints]) -> list[tuple[int, int]]:
    """Return pairs that probably show the same things: nearby by the poses, whose axes may be wrong, or in the order given."""
    count = len(images)
    pairs = {(i, i + step) for step in (1, 3) for i in range(count - step)}
    if count > 1:
        near = likely_pairs_of_poses([image.T_world_camera for image in images], 2)
        pairs |= {(i, j) for i, j in near.tolist()}
    ordered = sorted(pairs)
    return ordered[:: max(1, -(-len(ordered) // MOST_PAIRS))]


def _rotation(a: PosedKeypoints, b: PosedKeypoints) -> Float[Tensor, "3 3"] | None:
    """Return R_b_a by the essential matrix of matching keypoints; None if too few agree."""
    if min(len(a.keypoints), len(b.keypoints)) < ENOUGH_MATCHES:
        return None
    distance = squared_distances(a.keypoints.descriptors, b.keypoints.descriptors)
    nearest = distance.topk(2, largest=False)
    partner = nearest.indices[:, 0]
    mutual = distance.argmin(0)[partner] == torch.arange(len(partner))
    rows = (mutual & (nearest.values[:, 0] < RATIO**2 * nearest.values[:, 1])).nonzero()[:, 0]
    if len(rows) < ENOUGH_MATCHES:
        return None
    first, second = a.rays[rows, :2].double().numpy(), b.rays[partner[rows], :2].double().numpy()
    eye, threshold = np.eye(3), SEEN_PIXELS / min(a.focal, b.focal)
    cv2.setRNGSeed(0)
    found, mask = cv2.findEssentialMat(first, second, eye, cv2.RANSAC, prob=0.999, threshold=threshold)
    if found is None or found.shape != (3, 3):
        return None
    agreeing, rotation, _, _ = cv2.recoverPose(found, first, second, eye, mask=mask)
    return torch.from_numpy(rotation).double() if agreeing >= ENOUGH_MATCHES else None
