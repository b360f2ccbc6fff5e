"""Matching by descriptors alone, before any pose is known: the nearest landmarks of each keypoint.

Their search takes a time sublinear in the number of landmarks.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from bidnerf_core.devices import moved
from bidnerf_core.errors import InputError
from bidnerf_core.localization.landmarks.correspondences import MAX_AMBIGUITY, LandmarkMatches
from bidnerf_core.mapping import (
    BLOCK,
    Features,
    FoundOnce,
    ImageKeypoints,
    LandmarkMap,
    detected,
    find_features,
    k_means,
    nearest_centre,
    squared_distances,
)

EXHAUSTIVE = 4_000
"""The number of landmarks up to which the search is exhaustive, without cells."""
COMPARISONS = 4_000_000
"""The number of keypoint-landmark pairs up to which comparing all of them is faster than searching cells."""
USUAL_IN_CELL = 500
"""Mean number of landmarks per cell in large maps, where comparing them would otherwise take most of the time."""
PROBED = 12
"""Number of cells that are searched for each keypoint."""


class LandmarkMatcher:
    """Finds the landmarks whose descriptors are nearest to those of keypoints.

    Above ``EXHAUSTIVE`` landmarks, it uses an inverted file: k-means divides the landmarks into sqrt(n) cells (more in large
    maps), and only the cells nearest to a keypoint are searched (Sivic and Zisserman 2003; Jegou et al. 2011). Threads may share
    a matcher. It also prepares ``LandmarkMap.cells`` for guided matching.

    Descriptors are compared on the device of those of ``landmarks``; all other computations with landmarks run on the CPU.
    """

    def __init__(self, landmarks: LandmarkMap, seed: int = 0) -> None:
        self.landmarks = landmarks.to("cpu")
        _ = self.landmarks.cells
        self._descriptors = landmarks.descriptors
        self._cells: _Cells | None = None
        self._found_once: FoundOnce | None = None
        if len(landmarks) > EXHAUSTIVE:
            self._cells = _Cells(landmarks.descriptors, seed)

    @property
    def features(self) -> Features:
        """The keypoint detector and descriptor that the landmarks were built with.

        Raises ``PluginError`` (an ``InputError``) if its plugin is not installed.
        """
        return self._found_once or find_features(
            self.landmarks.features, "the detector of the map's landmarks"
        )

    def for_query(self) -> LandmarkMatcher:
        """Return a matcher for one query, whose ``features`` cache the keypoints of each image; all else is shared."""
        found = copy.copy(self)
        found._found_once = FoundOnce(lambda rgb: detected(self.features, rgb))
        return found

    def nearest(
        self, descriptors: UInt8[Tensor, "q d"], count: int
    ) -> tuple[Float[Tensor, "q k"], Int[Tensor, "q k"]]:
        """Return the squared distances and the indices of the ``count`` nearest landmarks, nearest first.

        If there are fewer landmarks, the remaining distances are infinite and the indices 0. Both are on the CPU.
        """
        channels = self._descriptors.shape[1]
        if descriptors.shape[1] != channels:
            raise InputError(
                f"the map's descriptors have {channels} channels, those of the image {descriptors.shape[1]}; "
                "use the detector with which the map was baked, or bake it again"
            )
        there = descriptors.to(self._descriptors.device)
        if self._cells is not None and len(descriptors) * len(self.landmarks) > COMPARISONS:
            return moved(self._cells.nearest(there, count), "cpu")
        distances = torch.full((len(descriptors), count), torch.inf)
        index = torch.zeros(distances.shape, dtype=torch.long)
        if len(self.landmarks):
            found = moved(_smallest(squared_distances(there, self._descriptors), count), "cpu")
            distances[:, : found[0].shape[1]], index[:, : found[0].shape[1]] = found
        return distances, index


class _Cells:
    """An inverted file: descriptors sorted by cell."""

    def __init__(self, descriptors: UInt8[Tensor, "n d"], seed: int) -> None:
        count = round(max(math.sqrt(len(descriptors)), len(descriptors) / USUAL_IN_CELL))
        generator = torch.Generator().manual_seed(seed)
        self._centres = k_means(descriptors, count, generator)
        cell = nearest_centre(descriptors, self._centres)
        order = cell.argsort(stable=True)
        self._order = order
        self._descriptors = descriptors[order]
        self._squares = torch.cat(
            [part.float().square().sum(-1) for part in self._descriptors.split(BLOCK // 256)]
        )
        self._last = torch.bincount(cell, minlength=count).cumsum(0).tolist()

    def nearest(
        self, descriptors: UInt8[Tensor, "q d"], count: int
    ) -> tuple[Float[Tensor, "q k"], Int[Tensor, "q k"]]:
        queries = len(descriptors)
        probed = _smallest(squared_distances(descriptors, self._centres), PROBED)[1]
        cell, order = probed.flatten().sort(stable=True)
        query = order // probed.shape[1]
        distances = torch.full((probed.numel(), count), torch.inf, device=probed.device)
        index = torch.zeros(distances.shape, dtype=torch.long, device=probed.device)
        values = descriptors.float()
        bounds = torch.searchsorted(cell, torch.arange(len(self._centres) + 1, device=cell.device)).tolist()
        for number, (begin, end) in enumerate(pairwise(bounds)):
            first, last = self._last[number - 1] if number else 0, self._last[number]
            if begin == end or first == last:
                continue
            others = self._descriptors[first:last].float()
            # The squares of the keypoint's own descriptor do not change the order, and are added at the end.
            partial = torch.addmm(self._squares[first:last], values[query[begin:end]], others.T, alpha=-2)
            found = _smallest(partial, count)
            width = found[0].shape[1]
            distances[order[begin:end], :width] = found[0]
            index[order[begin:end], :width] = found[1] + first
        best = distances.view(queries, -1).topk(count, dim=1, largest=False)
        squares = values.square().sum(-1, keepdim=True)
        return (best.values + squares).clamp_(min=0), self._order[
            index.view(queries, -1).gather(1, best.indices)
        ]


def _smallest(distances: Float[Tensor, "q n"], count: int) -> tuple[Float[Tensor, "q k"], Int[Tensor, "q k"]]:
    """Return the ``count`` smallest values of each row (all, if there are fewer), ascending, and their columns."""
    found = distances.topk(min(count, distances.shape[1]), dim=1, largest=False)
    return found.values, found.indices


STRONGEST = 700
"""Number of an image's strongest keypoints that are matched first; all are matched only if these do not suffice."""
LOOKED_UP = 4
"""Number of landmarks looked up per keypoint; the best one at another place determines the ambiguity of the match."""
SAME_PLACE = 2.0
"""Distance between landmarks, in diameters, below which they are duplicates of one point."""
LEAST_MATCHES = 60
"""Number of matches up to which the least ambiguous others are added to the unambiguous ones."""


def unguided_matches(
    images: Sequence[ImageKeypoints], matcher: LandmarkMatcher, strongest: int
) -> LandmarkMatches:
    """Return the matches of keypoints with their nearest landmarks that pass the ratio test, least ambiguous first.

    Only the ``strongest`` keypoints of each image are matched.
    """
    parts = []
    for number, image in enumerate(images):
        distances, index = matcher.nearest(image.keypoints.descriptors[:strongest], LOOKED_UP)
        ambiguity = _ambiguity(matcher.landmarks, distances, index)
        keypoint = torch.arange(len(index))[distances[:, 0].isfinite()]
        part = LandmarkMatches(
            torch.full_like(keypoint, number), keypoint, index[keypoint, 0], ambiguity[keypoint]
        )
        parts.append(part)
    found = LandmarkMatches.cat(parts)
    found = found[found.ambiguity.argsort(stable=True)]
    return found[torch.arange(len(found)) < max(LEAST_MATCHES, int((found.ambiguity <= MAX_AMBIGUITY).sum()))]


def _ambiguity(
    landmarks: LandmarkMap, distances: Float[Tensor, "q k"], index: Int[Tensor, "q k"]
) -> Float[Tensor, "q"]:
    """Return the ratio of the descriptor distances of the nearest landmark and the best one at another place."""
    if not len(landmarks):
        return torch.ones(len(distances))
    position, size = landmarks.positions[index], landmarks.sizes[index]
    apart = torch.linalg.vector_norm(position - position[:, :1], dim=-1)
    near = SAME_PLACE * torch.maximum(size, size[:, :1]) + 3 * landmarks.deviations[index].amax(-1)
    elsewhere = torch.where(apart > near, distances, torch.inf).amin(1)
    # If all landmarks looked up are at one place, the last distance is a lower bound for any other.
    other = torch.where(elsewhere.isfinite(), elsewhere, distances[:, -1])
    return torch.where(other.isfinite(), (distances[:, 0] / other.clamp(min=1)).sqrt(), 0.0)
