"""Detection of poses that contradict their images, and of pose conventions that would resolve the contradiction.

Keypoint matches between two images are found from the images alone (RANSAC with an essential
matrix, Nistér, PAMI 2004). Under correct poses, these matches lie on their epipolar lines, and the triangulated points lie
in front of both cameras; the lines alone do not determine the sign of a baseline (Hartley, Cheirality, IJCV
1998). Poses are wrong if they disagree with most pairs of images. Each reading of the poses (another convention, or
a common mistake undone) is a transformation of all poses of a capture, and is tested in the same way.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from kornia.geometry.conversions import quaternion_to_rotation_matrix, rotation_matrix_to_quaternion
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import LEAST_BASELINE, ImageKeypoints, likely_pairs, mutual_matches

MOST_PAIRS = 40
"""Largest number of image pairs examined from those suggested by poses and image order, and again from those
suggested by image similarity."""
ENOUGH_MATCHES = 40
"""Smallest number of inliers of an essential matrix for two images to count as a matched pair."""
USUAL_FOCAL = 700.0
"""Focal length (pixels) beyond which the pixel size is scaled up: keypoints of large images are detected in
downscaled copies."""
AGREED = 0.7
"""Smallest fraction of a pair's matches that must lie near their epipolar lines, and in front of both cameras, for the pair to
agree with poses; also the smallest fraction of pairs that must agree with a reading for it to be suggested."""


AS_GIVEN = torch.eye(3, dtype=torch.float64)
Y_AND_Z_REVERSED = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
REVERSED_TOO = ", and their cameras' y and z axes are reversed"
SWAP = "multiply each from the right by diag(1, -1, -1, 1)"


@dataclass(frozen=True)
class Reading:
    """One interpretation of the given poses, in words and as a transformation."""

    clause: str  # completes "the poses would agree if ..."
    remedy: str  # what to do about it
    understand: Callable[[SE3], SE3]
    """Maps the given poses (n) to the true T_world_camera; NaN for an image left without a pose."""


@dataclass(frozen=True)
class PoseContradiction:
    """A contradiction between poses and images, and the reading of the poses that would resolve it, if any."""

    pairs: int  # number of image pairs with enough matches
    agreeing_as_given: int
    reading: Reading | None = None
    agreeing: int = 0  # pairs with which the reading agrees

    @property
    def sentence(self) -> str:
        """Human-readable description of the problem and its remedy."""
        statement = (
            f"the poses contradict the photos: they agree with the keypoints of {self.agreeing_as_given} of {self.pairs}"
            " pairs of photos"
        )
        if self.reading is None:
            return (
                f"{statement}, and no common mistake explains it; check that each pose belongs to its photo,"
                " that the matrices are camera to world, and the camera's focal length and distortion"
            )
        return f"{statement}, but would agree with those of {self.agreeing} if {self.reading.clause}; {self.reading.remedy}"


def pose_contradiction(images: Sequence[ImageKeypoints]) -> PoseContradiction | None:
    """Return how the poses of ``images`` contradict the images; None if they agree, or if the images are inconclusive."""
    # Images overlap that are neighbours according to the poses, which may be wrong, or in the order of ``images``.
    near = [(i, j) for i, j in likely_pairs([image.T_ref_camera for image in images], 2).tolist()]
    ordered = sorted({*near, *((i, i + step) for step in (1, 3) for i in range(len(images) - step))})
    proposed = ordered[:: max(1, -(-len(ordered) // MOST_PAIRS))]
    pairs = [pair for i, j in proposed if (pair := match_pair(images, i, j)) is not None]
    if len(pairs) < MOST_PAIRS / 2:
        others = [pair for pair in _similar(images) if pair not in proposed][:MOST_PAIRS]
        pairs += [pair for i, j in others if (pair := match_pair(images, i, j)) is not None]
    if len(pairs) < 8:  # too few to judge the poses
        return None
    poses = SE3.stack([image.T_ref_camera for image in images])
    agrees = [bool(pair.agreeing(poses[None])[0]) for pair in pairs]
    as_given = sum(agrees)
    if as_given > 0.75 * len(pairs):
        return None
    tried = readings(len(images))
    understood = SE3.stack([reading.understand(poses) for reading in tried])
    agreeing = torch.stack([pair.agreeing(understood).double() for pair in pairs]).sum(0)
    best = int(agreeing.max())
    refused = as_given < 0.5 * len(pairs)
    # Some mistakes hardly show when cameras move in a plane, so poses that most pairs agree with may be wrong, too.
    if best >= (AGREED if refused else 0.9) * len(pairs):
        # A more common reading is preferred if it is almost the best.
        number = int((agreeing >= 0.9 * best).nonzero()[0, 0])
        return PoseContradiction(len(pairs), as_given, tried[number], int(agreeing[number]))
    if not refused:
        return None
    # Two images that do not agree with each other, but each with a neighbour, show places that look alike.
    disputes = [{pair.first, pair.second} for pair, agreed in zip(pairs, agrees, strict=True) if not agreed]
    nearby = [match_pair(images, i, j) for i, j in near if any({i, j} & both for both in disputes)]
    sound = {i for pair in nearby if pair and bool(pair.agreeing(poses[None])[0]) for i in (pair.first, pair.second)}
    conclusive = len(pairs) - sum(both <= sound for both in disputes)
    return PoseContradiction(len(pairs), as_given) if as_given < 0.5 * conclusive else None


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two images, by index, and their matched points on the plane z = 1."""

    first: int
    second: int
    seen_by_first: Float[Tensor, "m 3"]
    seen_by_second: Float[Tensor, "m 3"]
    pixel: float  # size of a pixel on the plane z = 1, scaled up in large images (see ``USUAL_FOCAL``)

    def agreeing(self, T: SE3) -> Bool[Tensor, "h"]:
        """Return for which hypotheses of T_world_camera (h n) the matches lie near their epipolar lines and in front of both cameras.

        Only points with enough parallax reveal whether they are in front of the cameras. Their depths solve
        ``a seen = b rays + moved`` in the least-squares sense along the common normal of both rays.
        """
        R_second_world = T.rotation[:, self.second].mT
        baseline = T.translation[:, self.first] - T.translation[:, self.second]
        moved = (R_second_world @ baseline[..., None])[:, None, :, 0]
        rays = self.seen_by_first @ (R_second_world @ T.rotation[:, self.first]).mT
        seen, moved = self.seen_by_second.expand_as(rays), moved.expand_as(rays)
        lines = torch.linalg.cross(moved, rays)
        away = (lines * seen).sum(-1) / torch.linalg.vector_norm(lines[..., :2], dim=-1)
        # Without a baseline, there are no epipolar lines, and the directions must agree.
        still = torch.linalg.vector_norm(rays[..., :2] / rays[..., 2:] - seen[..., :2], dim=-1)
        at_rest = torch.linalg.vector_norm(moved[:, 0], dim=-1) < LEAST_BASELINE
        away = torch.where(at_rest[:, None], still, away)
        # Matches may be off by two pixels. In an image of usual size, small errors of correct poses may cause four.
        near = (away.abs() <= max(4 / USUAL_FOCAL, 2 * self.pixel)).double().mean(-1) >= AGREED
        normal = torch.linalg.cross(seen, rays)
        a = (torch.linalg.cross(moved, rays) * normal).sum(-1)
        b = (torch.linalg.cross(moved, seen) * normal).sum(-1)
        lengths = torch.linalg.vector_norm(seen, dim=-1) * torch.linalg.vector_norm(rays, dim=-1)
        shows = torch.linalg.vector_norm(normal, dim=-1) / lengths > 3 * self.pixel
        front = ((a > 0) & (b > 0) & shows).sum(-1)
        return near & ((shows.sum(-1) < 10) | (front >= AGREED * shows.sum(-1)) | at_rest)


def _similar(images: Sequence[ImageKeypoints]) -> list[tuple[int, int]]:
    """Return pairs of images that probably overlap, most similar first.

    Each of up to 60 images is paired with the two images that share the most matches with it (at least twelve) among the
    300 strongest keypoints.
    """
    chosen = range(0, len(images), max(1, -(-len(images) // 60)))
    strongest = [images[i].keypoints.descriptors[:300] for i in chosen]
    counts = {
        (a, b): len(mutual_matches(strongest[a], strongest[b])[0])
        for a, b in itertools.combinations(range(len(chosen)), 2)
    }
    selected = set[tuple[int, int]]()
    for number in range(len(chosen)):
        own = sorted((pair for pair in counts if number in pair), key=lambda pair: -counts[pair])
        selected |= {pair for pair in own[:2] if counts[pair] >= 12}
    return [(chosen[a], chosen[b]) for a, b in sorted(selected, key=lambda pair: -counts[pair])]


def match_pair(images: Sequence[ImageKeypoints], i: int, j: int) -> MatchedPair | None:
    """Return the matches of two images that are inliers of an essential matrix; None if there are too few."""
    a, b = images[i], images[j]
    rows, partner = mutual_matches(a.keypoints.descriptors, b.keypoints.descriptors)
    if len(rows) < ENOUGH_MATCHES:
        return None
    first, second, focal = a.rays[rows], b.rays[partner], min(a.focal, b.focal)
    pixel = max(1.0, focal / USUAL_FOCAL) / focal  # one pixel on the plane z = 1, scaled up in large images
    cv2.setRNGSeed(0)
    essential, mask = cv2.findEssentialMat(
        first[:, :2].numpy(), second[:, :2].numpy(), np.eye(3), cv2.RANSAC, prob=0.999, threshold=pixel
    )
    if essential is None or len(mask) != len(rows):
        return None
    inliers = torch.from_numpy(mask[:, 0].astype(bool))
    if int(inliers.sum()) < ENOUGH_MATCHES:
        return None
    return MatchedPair(i, j, first[inliers], second[inliers], pixel)


@cache
def readings(count: int) -> tuple[Reading, ...]:
    """Return the readings to try for ``count`` poses, most common first: of readings that fit equally well, the first is preferred."""
    of_parts = itertools.chain.from_iterable(_in_file_axes(*part) for part in POSE_PARTS)
    return (*_of_axes(), *of_parts, *_of_quaternions(), *_of_worlds(), *_of_positions(), *_of_orders(count))


def reinterpret(
    T: SE3,
    axes: Float[Tensor, "3 3"] = AS_GIVEN,
    positions: Float[Tensor, "3 3"] = AS_GIVEN,
    mirror: Float[Tensor, "3 3"] = AS_GIVEN,
    inverted: bool = False,
) -> SE3:
    """Return poses with rotations ``mirror R axes`` and translations ``positions t``; T = [R | t] is inverted first if ``inverted``.

    The columns of ``axes`` are the true camera's axes in the given camera's frame.
    """
    T = T.inverse() if inverted else T
    return SE3(mirror @ T.rotation @ axes, T.translation @ positions.mT)


def _of_axes() -> Iterator[Reading]:
    """Yield readings with other camera axes, starting with y and z reversed, then readings of inverted matrices with any axes."""
    yield Reading(
        "their cameras' y and z axes are reversed (OpenCV's and COLMAP's axes where OpenGL's and Blender's are expected, or the"
        " other way round)",
        SWAP,
        partial(reinterpret, axes=Y_AND_Z_REVERSED),
    )
    rotations = signed_permutations(1)  # as given first, then with y and z reversed
    for axes in rotations[2:]:
        yield Reading(
            f"their cameras have other axes: {_name_axes(axes)}",
            "permute and reverse the first three columns of each accordingly",
            partial(reinterpret, axes=axes),
        )
    for number, axes in enumerate(rotations):
        yield Reading(
            f"they are inverses (world to camera){'' if number < 2 else f', of cameras whose {_name_axes(axes)}'}",
            f"invert each, and if they are then rejected again, {SWAP}",
            partial(reinterpret, axes=axes, inverted=True),
        )


POSE_PARTS: tuple[tuple[str, str, Callable[[SE3], SE3]], ...] = (
    (
        "their rotations are transposed, while their positions are right",
        "transpose the upper left 3x3 of each",
        lambda T: SE3(T.rotation.mT, T.translation),
    ),
    (
        "their positions are negated",
        "multiply the first three numbers of the fourth column of each by -1",
        lambda T: SE3(T.rotation, -T.translation),
    ),
    (
        "their translations are those of inverses, while their rotations are not",
        "replace each translation t by -R t",
        lambda T: SE3(T.rotation, -T.rotate(T.translation)),
    ),
    (
        "their rotations are transposed and their positions negated",
        "transpose the upper left 3x3 of each, and negate the fourth column",
        lambda T: SE3(T.rotation.mT, -T.translation),
    ),
    (
        "they are inverses whose translations lack the minus sign",
        "transpose each rotation R, and replace t by R^T t",
        lambda T: SE3(T.rotation.mT, -T.inverse().translation),
    ),
    (
        "their translations are -R times the positions",
        "replace each translation t by -R^T t",
        lambda T: SE3(T.rotation, T.inverse().translation),
    ),
    (
        "their translations are those of inverses without the minus sign, while their rotations are not",
        "replace each translation t by R t",
        lambda T: SE3(T.rotation, T.rotate(T.translation)),
    ),
    (
        "their translations are R times the positions",
        "replace each translation t by R^T t",
        lambda T: SE3(T.rotation, -T.inverse().translation),
    ),
    (
        "their rotations are transposed, and their translations rotated",
        "transpose each rotation R, and replace t by R t",
        lambda T: SE3(T.rotation.mT, T.rotate(T.translation)),
    ),
    (
        "their rotations are transposed, and their translations rotated and negated",
        "transpose each rotation R, and replace t by -R t",
        lambda T: SE3(T.rotation.mT, -T.rotate(T.translation)),
    ),
)
"""Mistakes in a part of each pose: what is wrong, the remedy, and the true poses as a function of the given ones."""


def _of_quaternions() -> Iterator[Reading]:
    """Yield readings of quaternions with w taken from the wrong end, for poses and for their inverses."""

    def understand(T: SE3, order: list[int], of_inverse: bool, then_invert: bool) -> SE3:
        T = T.inverse() if of_inverse else T
        quaternion = rotation_matrix_to_quaternion(T.rotation.contiguous())  # w x y z
        T = SE3(quaternion_to_rotation_matrix(quaternion[..., order]), T.translation)
        return T.inverse() if of_inverse != then_invert else T

    orders = (([3, 0, 1, 2], "x y z w", "w x y z"), ([1, 2, 3, 0], "w x y z", "x y z w"))
    for (order, given, expected), of_inverse, then_invert in itertools.product(orders, (False, True), (False, True)):
        also = ", and the poses are inverses (world to camera)" if then_invert else ""
        yield from _in_file_axes(
            f"their quaternions are in the order {given}, but {expected} is expected{also}",
            f"write the quaternions as {expected}{', and invert the poses' if then_invert else ''}",
            partial(understand, order=order, of_inverse=of_inverse, then_invert=then_invert),
        )


def _of_worlds() -> Iterator[Reading]:
    """Yield readings of left-handed worlds, as in Unity and Unreal. Mirroring another axis instead merely rotates the world."""
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64))
    for axes in sorted(signed_permutations(-1), key=lambda axes: not torch.equal(axes, mirror)):
        yield Reading(
            "their axes are left-handed, as in Unity",
            f"multiply each from the left by diag(1, 1, -1, 1); {_name_axes(axes)} then",
            partial(reinterpret, axes=axes, positions=mirror, mirror=mirror),
        )


def _of_positions() -> Iterator[Reading]:
    """Yield readings in which positions use different axes from rotations."""
    for D in (*signed_permutations(-1), *signed_permutations(1)[1:]):
        order = ", ".join(("-" if row.sum() < 0 else "") + "xyz"[int(row.abs().argmax())] for row in D)
        for axes, also, swap in ((AS_GIVEN, "", ""), (Y_AND_Z_REVERSED, REVERSED_TOO, f", and {SWAP}")):
            yield Reading(
                f"x, y and z of their positions are the given ones' {order}{also}",
                f"correct the fourth column of each, not the rotations{swap}",
                partial(reinterpret, axes=axes, positions=D),
            )


def _of_orders(count: int) -> Iterator[Reading]:
    """Yield readings in which the poses are assigned to different images."""

    def understand(T: SE3, order: Sequence[int]) -> SE3:
        index = torch.tensor([i if 0 <= i < count else -1 for i in order])
        unknown = torch.where(index >= 0, 0.0, torch.nan).to(T.translation)
        return SE3(T.rotation[index], T.translation[index] + unknown[:, None])

    shifts = {
        1: "the next image",
        -1: "the image before",
        2: "the image after next",
        -2: "the image before the previous one",
    }
    orders = list[tuple[str, Sequence[int]]](
        (f"each is that of {words}", range(-by, count - by)) for by, words in shifts.items()
    )
    orders.append(("they are in the reverse order of the images", range(count)[::-1]))
    for first in (0, 1):
        by_text = sorted(range(count), key=lambda i, first=first: str(i + first))  # type: ignore[misc]
        text, numeric = "in text order (1, 10, 11, 2)", "in numeric order"
        orders += [
            (f"they are {text}, while the images are {numeric}", sorted(range(count), key=by_text.__getitem__)),
            (f"they are {numeric}, while the images are {text}", by_text),
        ]
    for clause, order in orders:
        yield from _in_file_axes(clause, "reassign the poses to the images", partial(understand, order=order))


def _in_file_axes(clause: str, remedy: str, understand: Callable[[SE3], SE3]) -> Iterator[Reading]:
    """Yield the reading in our camera axes and in those of a file with y and z reversed, then with a reversal on one side only."""

    def whole(T: SE3, before: Tensor, after: Tensor) -> SE3:
        return reinterpret(understand(reinterpret(T, before)), after)

    # The reader also reverses y and z of correct poses, so a reversal on both sides needs no remedy; one on a single side does.
    both = (AS_GIVEN, Y_AND_Z_REVERSED)
    for axes in both:
        yield Reading(clause, remedy, partial(whole, before=axes, after=axes))
    for before, after in (both, both[::-1]):
        yield Reading(clause + REVERSED_TOO, f"{remedy}, then {SWAP}", partial(whole, before=before, after=after))


def signed_permutations(determinant: int) -> list[Float[Tensor, "3 3"]]:
    """Return the 24 signed permutation matrices with a determinant of 1 or -1, starting with the identity if it is among them."""
    orders = itertools.product(itertools.permutations(range(3)), itertools.product((1.0, -1.0), repeat=3))
    candidates = (AS_GIVEN[list(order)] * torch.tensor([signs]).mT for order, signs in orders)
    return [A for A in candidates if round(float(torch.linalg.det(A))) == determinant]


def _name_axes(axes: Float[Tensor, "3 3"]) -> str:
    """Describe where the true camera's axes point, in terms of the given camera's axes."""
    names = ("right", "down", "forward"), ("left", "up", "backward")
    words = [names[int(column.sum() < 0)][int(column.abs().argmax())] for column in axes.mT]
    return "right, down and forward are the given ones' {}, {} and {}".format(*words)
