"""Detection of poses that contradict their images, and of conventions under which they would agree.

The keypoints of two images that show the same point are found from the images alone (RANSAC with an essential
matrix, Nistér, PAMI 2004). Under correct poses these matches lie on their epipolar lines, and their points in
front of both cameras; the lines alone do not determine the sign of a baseline (Hartley, Cheirality, IJCV
1998). Poses are wrong if they disagree with most pairs of images, and each reading of ``pose_readings`` is
tested in the same way.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from bidnerf_core.captures.pose_readings import AS_GIVEN, SWAP, Y_AND_Z_REVERSED, Reading, changed, readings
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import LEAST_BASELINE, ImageKeypoints, likely_pairs, squared_distances

MOST_PAIRS = 40
"""Largest number of examined pairs among those suggested by poses and order, and among those suggested by
image similarity."""
ENOUGH_PAIRS = 8
"""Smallest number of pairs with matches from which poses are judged."""
ENOUGH_MATCHES = 40
"""Smallest number of inlier matches to an essential matrix for a pair."""
USUAL_FOCAL = 700.0
"""Focal length (pixels) beyond which the pixel size is scaled up: keypoints of large images are detected in
downscaled ones."""
AGREED = 0.7
"""Smallest fraction of a pair's matches near their epipolar lines, of those in front of both cameras, and of the pairs for a
reading to be suggested."""


@dataclass(frozen=True)
class PoseContradiction:
    """Poses that disagree with the images, and the reading under which they would agree, if there is one."""

    pairs: int  # of images with matches
    agreeing_as_given: int
    reading: Reading | None = None
    agreeing: int = 0  # pairs with which the reading agrees

    @property
    def sentence(self) -> str:
        """Human-readable description of the problem and its remedy."""
        found = (
            f"the poses contradict the photos: they agree with the keypoints of {self.agreeing_as_given} of {self.pairs}"
            " pairs of photos"
        )
        if self.reading is None:
            return (
                f"{found}, and no common mistake explains it; check that each pose belongs to its photo,"
                " that the matrices are camera to world, and the camera's focal length and distortion"
            )
        return (
            f"{found}, but would agree with those of {self.agreeing} if {self.reading.clause};"
            f" {self.reading.remedy}"
        )


def pose_contradiction(images: Sequence[ImageKeypoints]) -> PoseContradiction | None:
    """Return how the poses of ``images`` contradict them; None if they agree, or if the images do not determine it."""
    proposed = _pairs(images)
    pairs = [pair for i, j in proposed if (pair := matched_pair(images, i, j)) is not None]
    if len(pairs) < MOST_PAIRS / 2:
        others = [pair for pair in _similar(images) if pair not in proposed][:MOST_PAIRS]
        pairs += [pair for i, j in others if (pair := matched_pair(images, i, j)) is not None]
    if len(pairs) < ENOUGH_PAIRS:
        return None
    poses = SE3.stack([image.T_ref_camera for image in images])
    agrees = [bool(pair.agreeing(poses[None])[0]) for pair in pairs]
    as_given = sum(agrees)
    if as_given > 0.75 * len(pairs):
        return None
    tried = [*readings(len(images)), *_fitted_positions(pairs, poses)]
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
    near = likely_pairs([image.T_ref_camera for image in images], 2).tolist()
    nearby = [matched_pair(images, i, j) for i, j in near if any({i, j} & both for both in disputes)]
    sound = {
        i
        for pair in nearby
        if pair and bool(pair.agreeing(poses[None])[0])
        for i in (pair.first, pair.second)
    }
    alike = sum(both <= sound for both in disputes)
    return PoseContradiction(len(pairs), as_given) if as_given < 0.5 * (len(pairs) - alike) else None


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two images, by index, and their matched points on the plane z = 1."""

    first: int
    second: int
    seen_by_first: Float[Tensor, "m 3"]
    seen_by_second: Float[Tensor, "m 3"]
    pixel: float  # size on the plane z = 1

    def agreeing(self, T: SE3) -> Bool[Tensor, "h"]:
        """Return for which poses T_world_camera (h n) the matches are near their epipolar lines and in front of both cameras.

        Only points with enough parallax show on which side of the cameras they are. Their depths solve
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
        # Matches may be off by two pixels, and small errors of correct poses may cause four in a usual image.
        near = (away.abs() <= max(4 / USUAL_FOCAL, 2 * self.pixel)).double().mean(-1) >= AGREED
        normal = torch.linalg.cross(seen, rays)
        a = (torch.linalg.cross(moved, rays) * normal).sum(-1)
        b = (torch.linalg.cross(moved, seen) * normal).sum(-1)
        lengths = torch.linalg.vector_norm(seen, dim=-1) * torch.linalg.vector_norm(rays, dim=-1)
        shows = torch.linalg.vector_norm(normal, dim=-1) / lengths > 3 * self.pixel
        front = ((a > 0) & (b > 0) & shows).sum(-1)
        return near & ((shows.sum(-1) < 10) | (front >= AGREED * shows.sum(-1)) | at_rest)


def _fitted_positions(pairs: Sequence[MatchedPair], poses: SE3) -> list[Reading]:
    """Return readings whose positions are a linear function of the given ones, fitted to the epipolar lines of all pairs.

    They cover positions scaled along one axis, and positions and rotations from different world frames.
    """
    found = []
    swaps = (
        (AS_GIVEN, "", ""),
        (Y_AND_Z_REVERSED, ", and their cameras' y and z axes are reversed", f", and {SWAP}"),
    )
    for axes, also, swap in swaps:
        for B in _fitted(pairs, changed(poses, axes)):
            clause, remedy = (
                "their positions are in a different frame from their rotations",
                "take both from one source",
            )
            # Entries off the diagonal of up to 3 % of the largest are attributed to noise.
            if bool(((B - torch.diag(B.diagonal())).abs() < 0.03 * B.abs().max()).all()):
                scales = ", ".join(f"{value:.3g}" for value in (B.diagonal() / B[0, 0]).tolist())
                clause = "the axes of their positions are scaled differently"
                remedy = f"multiply the positions, not the rotations, by about diag({scales})"
            found.append(Reading(clause + also, remedy + swap, partial(changed, axes=axes, positions=B)))
    return found


def _fitted(pairs: Sequence[MatchedPair], T: SE3) -> list[Float[Tensor, "3 3"]]:
    """Return matrices that, multiplied with the positions, put matches on their epipolar lines.

    The first and second are the least-squares solution with either sign, up to scale. The last stays near the
    identity where the lines give no constraint, such as along a direction in which the cameras do not move.
    """
    rows, counts = [], []
    for pair in pairs:
        R, baseline = T.rotation[pair.second], T.translation[pair.first] - T.translation[pair.second]
        if float(baseline.norm()) < LEAST_BASELINE:
            continue
        rays = pair.seen_by_first @ (R.mT @ T.rotation[pair.first]).mT
        normal = torch.linalg.cross(rays, pair.seen_by_second)  # normal . R^T B baseline = 0
        normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True).median().clamp(min=1e-9)
        world = normal @ R.mT
        rows.append((world[:, :, None] * (baseline / baseline.norm())).flatten(1))
        counts.append(len(rays))
    if len(rows) < ENOUGH_PAIRS:
        return []
    A = torch.cat(rows)
    weight = torch.cat([torch.full((count,), 1 / count, dtype=torch.float64) for count in counts])
    free = _reweighted(A, weight, lambda H: torch.linalg.eigh(H).eigenvectors[:, 0]).reshape(3, 3)
    return [free, -free, _reweighted(A, weight, _near_identity).reshape(3, 3)]


def _reweighted(
    A: Float[Tensor, "n 9"], weight: Float[Tensor, "n"], solve: Callable[[Tensor], Tensor]
) -> Float[Tensor, "9"]:
    """Return a robust solution of ``A b = 0``; ``solve`` solves given normal equations (9x9)."""
    share = weight
    for _ in range(10):  # reweighting
        solution = solve(A.mT @ (share[:, None] * A))
        off = (A @ solution).abs()
        share = weight / (1 + (off / off.median().clamp(min=1e-9)) ** 2)
    return solution


def _near_identity(H: Float[Tensor, "9 9"]) -> Float[Tensor, "9"]:
    """Minimize ``b H b + prior |b - 1|^2`` over matrices b of trace 3."""
    identity = torch.eye(3, dtype=H.dtype).flatten()
    prior = 1e-4 * H.diagonal().mean()  # the identity's weight, relative to that of the matches
    system = torch.zeros((10, 10), dtype=H.dtype)
    system[:9, :9] = H + prior * torch.eye(9, dtype=H.dtype)
    system[:9, 9] = system[9, :9] = identity
    right = torch.cat([prior * identity, identity.new_tensor([3.0])])
    return torch.linalg.solve(system, right)[:9]


def _pairs(images: Sequence[ImageKeypoints]) -> list[tuple[int, int]]:
    """Return pairs that probably show the same things.

    They are nearby according to the poses, which may be wrong, or in the given order.
    """
    count = len(images)
    pairs = {(i, i + step) for step in (1, 3) for i in range(count - step)}
    near = likely_pairs([image.T_ref_camera for image in images], 2)
    pairs |= {(i, j) for i, j in near.tolist()}
    ordered = sorted(pairs)
    return ordered[:: max(1, -(-len(ordered) // MOST_PAIRS))]


def _similar(images: Sequence[ImageKeypoints]) -> list[tuple[int, int]]:
    """Return pairs of images that probably show the same things, most similar first.

    Each of up to 60 images is paired with the two that have most matches with it, twelve at least, among the 300 strongest
    keypoints.
    """
    chosen = range(0, len(images), max(1, -(-len(images) // 60)))
    strongest = [images[i].keypoints.descriptors[:300] for i in chosen]
    pairs = itertools.combinations(range(len(chosen)), 2)
    found = {(a, b): len(_mutual(strongest[a], strongest[b])[0]) for a, b in pairs}
    kept = set[tuple[int, int]]()
    for number in range(len(chosen)):
        own = sorted((pair for pair in found if number in pair), key=lambda pair: -found[pair])
        kept |= {pair for pair in own[:2] if found[pair] >= 12}
    return [(chosen[a], chosen[b]) for a, b in sorted(kept, key=lambda pair: -found[pair])]


def _mutual(a: UInt8[Tensor, "n d"], b: UInt8[Tensor, "m d"]) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
    """Return the indices of descriptors that are mutual nearest neighbours and pass the ratio test of Lowe 2004."""
    if min(len(a), len(b)) < 2:
        return torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long)
    distance = squared_distances(a, b)
    nearest = distance.topk(2, largest=False)
    partner = nearest.indices[:, 0]
    mutual = distance.argmin(0)[partner] == torch.arange(len(partner))
    rows = (mutual & (nearest.values[:, 0] < 0.8**2 * nearest.values[:, 1])).nonzero()[:, 0]
    return rows, partner[rows]


def matched_pair(images: Sequence[ImageKeypoints], i: int, j: int) -> MatchedPair | None:
    """Return two images' inlier matches to an essential matrix; None if these are too few."""
    a, b = images[i], images[j]
    if min(len(a.keypoints), len(b.keypoints)) < ENOUGH_MATCHES:
        return None
    rows, partner = _mutual(a.keypoints.descriptors, b.keypoints.descriptors)
    if len(rows) < ENOUGH_MATCHES:
        return None
    first, second, focal = a.rays[rows], b.rays[partner], min(a.focal, b.focal)
    pixel = max(1.0, focal / USUAL_FOCAL) / focal
    cv2.setRNGSeed(0)
    found, mask = cv2.findEssentialMat(
        first[:, :2].numpy(), second[:, :2].numpy(), np.eye(3), cv2.RANSAC, prob=0.999, threshold=pixel
    )  # fmt: skip
    if found is None or len(mask) != len(rows):
        return None
    kept = torch.from_numpy(mask[:, 0].astype(bool))
    if int(kept.sum()) < ENOUGH_MATCHES:
        return None
    return MatchedPair(i, j, first[kept], second[kept], pixel)
