"""Matches of keypoints with landmarks: by descriptors alone, and by projection from a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.camera import exposure_times
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.localization.query import Query
from bidnerf_core.localization.states import Sights, States, project
from bidnerf_core.mapping import LandmarkMap, paired_squared_distances

STRONGEST, LOOKED_UP = 700, 4
"""Number of an image's keypoints that are matched by descriptors alone at first, and of landmarks looked up for each."""
AMBIGUITY = 0.9
"""Largest ratio of the descriptor distances of the best and the second-best landmark (Lowe 2004)."""
LEAST_MATCHES = 60
"""Number of matches up to which ambiguous ones are added."""
ALIKE = 0.6
"""Largest descriptor distance of a match by projection, relative to that of unrelated descriptors."""
CANDIDATES, OCTAVES, OBLIQUE = 6, 1.0, math.radians(40)
"""For matches by projection: landmarks compared with each keypoint, and limits of the differences in size and direction."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Pairs of a keypoint and a landmark, the most reliable first."""

    keypoint: Int[Tensor, "m"]
    landmark: Int[Tensor, "m"]

    def __len__(self) -> int:
        return len(self.keypoint)

    def __getitem__(self, index: Tensor) -> Matches:
        return Matches(self.keypoint[index], self.landmark[index])


@dataclass(frozen=True, eq=False)
class Nearest:
    """The landmarks with the most similar descriptors, for the strongest keypoints of each view."""

    keypoint: Int[Tensor, "k"]
    distance: Float[Tensor, "k n"]  # squared, ascending
    landmark: Int[Tensor, "k n"]
    ambiguity: Float[
        Tensor, "k"
    ]  # ratio of the distances of the best landmark and the best one at another place

    @staticmethod
    def of(query: Query, matcher: LandmarkMatcher, strongest: int) -> Nearest:
        landmarks = matcher.landmarks
        first = torch.searchsorted(query.view, query.view)
        keypoint = (torch.arange(len(query.view)) - first < strongest).nonzero()[:, 0]
        distance, index = matcher.nearest(query.keypoints.descriptors[keypoint], LOOKED_UP)
        position, size = landmarks.positions[index], landmarks.sizes[index]
        apart = (position - position[:, :1]).norm(dim=-1)
        same = apart <= 2 * torch.maximum(size, size[:, :1]) + 3 * landmarks.deviations[index].amax(-1)
        other = torch.where(same, torch.inf, distance).amin(1)
        other = torch.where(other.isfinite(), other, distance[:, -1])
        return Nearest(
            keypoint, distance, index, (distance[:, 0] / other.clamp(min=1)).sqrt().nan_to_num(1.0)
        )

    @property
    def best(self) -> Matches:
        """The unambiguous matches, filled up with others if they are few."""
        order = self.ambiguity.argsort(stable=True)
        count = max(LEAST_MATCHES, int((self.ambiguity <= AMBIGUITY).sum()))  # host
        return Matches(self.keypoint[order[:count]], self.landmark[order[:count], 0])

    def others(self, near: Bool[Tensor, "k n"]) -> Matches:
        """Return matches with landmarks as similar as the nearest one, but not among those that a pose projects ``near``."""
        ratio = self.distance / self.distance[:, :1].clamp(min=1)
        row, column = (
            ((ratio <= AMBIGUITY**-2) & ~near & self.distance.isfinite()).nonzero().unbind(-1)
        )  # host
        order = (self.distance[row, column]).argsort(stable=True)
        return Matches(self.keypoint[row[order]], self.landmark[row, column][order])


class Projected:
    """The landmarks that one state should see, with their projections, view by view."""

    def __init__(self, query: Query, landmarks: LandmarkMap, state: States, margin: float) -> None:
        self.query, self.landmarks = query, landmarks
        self.visible, self._parts = 0, []
        for number, image in enumerate(query.images):
            self._parts.append(self._part(number, image, state, margin))

    def _part(self, number, image, state, margin):
        landmarks, c = self.landmarks, image.intrinsics
        nuisances = state.nuisances[0]
        focal = image.focal * float(nuisances[0].exp())  # host
        half = torch.tensor([max(c.cx, c.width - c.cx) / c.fx, max(c.cy, c.height - c.cy) / c.fy])
        half = half + nuisances[1:3].abs().float()
        own = self.query.view == number
        sizes = self.query.keypoints.sizes[own]
        smallest = float(sizes.min()) / (2**OCTAVES * focal) if len(sizes) else 0.0
        T = state.T[0] @ image.T_ref_camera
        slopes = (1.2 * half + margin / image.focal) / float(nuisances[0].exp())
        index, local = landmarks.in_view(T, slopes, OBLIQUE, smallest)
        points = landmarks.positions[index].double()
        there = image.T_ref_camera.inverse()
        m = len(points)
        sights = Sights(
            points[:, :2], points.new_zeros(m), there.rotation.expand(m, 3, 3), there.translation.expand(m, 3)
        )
        flat = project(state, points, sights).image[0]
        scale = torch.tensor([c.fx, c.fy], dtype=torch.float64)
        centre = torch.tensor([c.cx, c.cy], dtype=torch.float64)
        if bool((state.nuisances[0, 6:12] != 0).any()):
            times = exposure_times(flat * scale + centre, c)
            flat = project(
                state, points, Sights(sights.image, times, sights.rotation, sights.translation)
            ).image[0]
        shown = flat * scale + centre
        self.visible += int(((shown > 0) & (shown < torch.tensor([c.width, c.height]))).all(-1).sum())
        pixels = flat * image.focal
        expected = landmarks.sizes[index] * focal / local[:, 2]
        tree = cKDTree(pixels.numpy()) if m else None  # host
        return own.nonzero()[:, 0], image.focal, index, expected, tree

    def matches(self, radius: float, shift: float = 0.0) -> Matches:
        """Return the matches within ``radius`` pixels; with keypoints displaced by ``shift``, all are due to chance."""
        query, landmarks = self.query, self.landmarks
        pairs = []
        for own, focal, index, expected, tree in self._parts:
            if tree is None or not len(own):
                continue
            observed = query.sights.image[own] * focal + shift
            _, found = tree.query(observed.numpy(), k=CANDIDATES, distance_upper_bound=radius)  # host
            found = torch.from_numpy(np.asarray(found, dtype=np.int64).reshape(len(own), -1))
            row, column = (found < len(index)).nonzero().unbind(-1)
            place = found[row, column]
            alike = (expected[place] / query.keypoints.sizes[own[row]]).log2().abs() <= OCTAVES
            pairs.append(torch.stack([own[row], index[place]])[:, alike])
        keypoint, landmark = torch.cat([torch.zeros((2, 0), dtype=torch.long), *pairs], 1)
        distance = paired_squared_distances(
            query.keypoints.descriptors, landmarks.descriptors, keypoint, landmark
        )
        most = (ALIKE * landmarks.unrelated_distance) ** 2
        q = len(query.view)
        best = torch.full((q,), torch.inf).scatter_reduce_(0, keypoint, distance, "amin")
        is_best = distance == best[keypoint]
        second = torch.full((q,), most / AMBIGUITY**2)
        second = second.scatter_reduce_(0, keypoint[~is_best], distance[~is_best], "amin")
        good = is_best & (distance <= most) & (distance <= AMBIGUITY**2 * second[keypoint])
        keypoint, landmark, distance = keypoint[good], landmark[good], distance[good]
        # A landmark is seen once by each view.
        key = query.view[keypoint] * len(landmarks) + landmark
        least = torch.full((len(query.images) * len(landmarks),), torch.inf).scatter_reduce_(
            0, key, distance, "amin"
        )
        once = distance == least[key]
        return Matches(keypoint[once], landmark[once])


def log10_nfa(matches: int, agreeing: int, probability: float, sample: int = 3) -> float:
    """Return log10 of the number of false alarms (Moisan and Stival 2004, eq. 10): the expected number of poses with ``agreeing``
    inliers among ``matches`` if all are wrong, each an inlier with ``probability``; ``sample`` matches determine a pose.
    """
    if agreeing <= sample:
        return 0.0

    def log_binomial(n: int, k: int) -> float:
        return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)

    log = (
        math.log(max(1, matches - sample)) + log_binomial(matches, agreeing) + log_binomial(agreeing, sample)
    )
    return (log + (agreeing - sample) * math.log(probability)) / math.log(10)
