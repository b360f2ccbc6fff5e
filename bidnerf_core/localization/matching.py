"""The keypoints of a query, and their matches with landmarks: by descriptors alone, and by projection from a pose."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import pad

from bidnerf_core.camera import Intrinsics, exposure_times
from bidnerf_core.errors import InputError
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.mapping import (
    FEW_DESCRIPTORS,
    CachedFeatures,
    DescriptorCells,
    Features,
    HalfPrecisionSearch,
    ImageKeypoints,
    InvertedFile,
    Keypoints,
    LandmarkMap,
    Sights,
    States,
    detect,
    find_features,
    image_keypoints,
    imaged,
    paired_squared_distances,
    smallest,
    squared_distances,
)

CELLS = 10
"""Number of rows and columns of the grid whose occupied cells measure how far matches spread over an image."""


@dataclass(frozen=True, eq=False)
class QueryKeypoints:
    """The keypoints of all images, view by view, the strongest of each view first."""

    images: tuple[ImageKeypoints, ...]
    keypoints: Keypoints  # (q)
    view: Int[Tensor, "q"]
    sights: Sights  # (q)
    focal: Float[Tensor, "q"]  # pixels
    approximate: bool  # whether the focal length was only assumed or read from EXIF

    @staticmethod
    def of(views: Sequence[View], features: Features) -> QueryKeypoints:
        """Detect the keypoints of ``views``, whose ``T_ref_camera`` are relative to the last view."""
        images = tuple(image_keypoints(view, features) for view in views)  # host
        return QueryKeypoints.seen(images, any(view.frame.focal_is_approximate for view in views))

    @staticmethod
    def seen(images: tuple[ImageKeypoints, ...], approximate: bool) -> QueryKeypoints:
        counts = [len(image.keypoints) for image in images]
        view = torch.arange(len(images)).repeat_interleave(torch.tensor(counts))
        T = SE3.stack([image.T_ref_camera.inverse() for image in images])[view]
        names = ("pixels", "sizes", "descriptors")
        joined = (torch.cat([getattr(image.keypoints, name) for image in images]) for name in names)
        times = images[0].exposure_times if len(images) == 1 else torch.zeros(len(view)).double()
        rays = torch.cat([image.rays for image in images])[:, :2]
        focal = torch.tensor([image.focal for image in images], dtype=torch.float64)[view]
        last = images[-1].T_ref_camera.matrix()
        single = len(images) == 1 and torch.allclose(last, torch.eye(4, dtype=last.dtype), rtol=0, atol=1e-9)
        sights = Sights(rays, times, T.rotation, T.translation, single)
        return QueryKeypoints(images, Keypoints(*joined), view, sights, focal, approximate)

    @cached_property
    def mirrored(self) -> QueryKeypoints:
        """The keypoints of the mirror image (left and right swapped): SIFT's descriptors are permuted, not computed anew."""
        image = self.images[-1]
        k, c = image.keypoints, image.intrinsics
        pixels = torch.stack([c.width - k.pixels[:, 0], k.pixels[:, 1]], -1)
        there = Keypoints(pixels, k.sizes, k.descriptors[:, mirrored_sift()])
        rays = image.rays * image.rays.new_tensor([-1.0, 1.0, 1.0])
        swapped = replace(
            image,
            keypoints=there,
            rays=rays,
            intrinsics=replace(c, cx=c.width - c.cx),
            hidden=None if image.hidden is None else image.hidden.flip(1),
            T_ref_camera=SE3.identity(),
        )
        return QueryKeypoints.seen((swapped,), self.approximate)

    @property
    def camera(self) -> Intrinsics:
        """The stated camera of the last image."""
        return self.images[-1].intrinsics

    @property
    def has_one_camera(self) -> bool:
        return len({image.intrinsics for image in self.images}) == 1

    @property
    def threshold(self) -> float:
        """The largest reprojection error of an inlier, pixels."""
        return inlier_threshold(self.camera)

    @property
    def area(self) -> float:
        """The area of an image, in square pixels."""
        return float(self.camera.width * self.camera.height)

    @property
    def by_chance(self) -> float:
        """The probability that a wrong match, uniform in the image, is an inlier of a given pose."""
        return min(0.5, math.pi * self.threshold**2 / self.area)


def inlier_threshold(camera: Intrinsics) -> float:
    """Return the largest reprojection error of an inlier: 0.5 % of the image's diagonal, but at least two pixels."""
    return max(2.0, 0.005 * math.hypot(camera.width, camera.height))


def cells(pixels: Float[Tensor, "m 2"], camera: Intrinsics) -> Int[Tensor, "m"]:
    """Return the index of the image cell that contains each pixel (u, v)."""
    size = torch.tensor([camera.width, camera.height])
    column, row = (pixels / size * CELLS).long().clamp(0, CELLS - 1).unbind(-1)
    return row * CELLS + column


MANY_LANDMARKS = 100_000
"""Number of landmarks above which a query is first matched with those of the images most similar to it."""
VOTERS, LEAST_VOTES = 150, 5
"""Number of keypoints that vote for images or for maps, and of votes without which no image counts as similar."""


@lru_cache(maxsize=1)
def mirrored_sift() -> Int[Tensor, "128"]:
    """Return the permutation of channels that mirrors a SIFT descriptor: rows (across the orientation) and angles are reversed."""
    row, column, angle = torch.meshgrid(torch.arange(4), torch.arange(4), torch.arange(8), indexing="ij")
    return (((3 - row) * 4 + column) * 8 + (-angle) % 8).flatten()


SAMPLE = 3
"""Number of matches from which the solver of sample consensus (P3P) determines a pose."""
STRONGEST = 700
"""Number of an image's keypoints that are matched by descriptors alone at first."""
AMBIGUITY = 0.9
"""Largest ratio of the descriptor distances of the best and the second-best landmark (Lowe 2004)."""
OCTAVES, OBLIQUE = 1.0, math.radians(40)
"""Limits of the differences in size (octaves) and in viewing direction (radians) for matches by projection."""


@dataclass(frozen=True, eq=False)
class Places:
    """The landmarks that each image of a large map shows, by which a query is matched with those of similar images alone."""

    landmark: Int[Tensor, "m"]  # image by image
    first: Int[Tensor, "v"]  # the first entry of each image in ``landmark``, and the end
    image: Int[Tensor, "n"]  # the first image that shows each landmark
    index: InvertedFile

    @staticmethod
    def of(landmarks: LandmarkMap, index: InvertedFile) -> Places | None:
        """Sort the tracks of the landmarks; None if the landmarks are few, or their tracks unknown."""
        tracks = landmarks.tracks
        if tracks is None or len(landmarks) <= MANY_LANDMARKS:
            return None
        order = tracks.image.argsort(stable=True) if bool((tracks.image.diff() < 0).any()) else slice(None)
        landmark, image = tracks.landmark[order], tracks.image[order]
        first = torch.full((len(landmarks),), int(image[-1])).scatter_reduce(0, landmark.long(), image.long(), "amin")
        return Places(landmark, pad(torch.bincount(image).cumsum(0), (1, 0)), first, index)

    def shown(self, descriptors: UInt8[Tensor, "q d"]) -> Int[Tensor, "s"] | None:
        """Return the landmarks shown by the images that are similar to a query; None without such images, or if these show many.

        Each of some ``descriptors`` votes for the first image that shows the landmark nearest to it in its own cell; more cells take longer
        and give other places as many more votes. As another place that is as similar must not be missed, an image is similar if it has three
        tenths of the votes of the best one.
        """
        voters = torch.linspace(0, len(descriptors) - 1, min(len(descriptors), VOTERS)).long()
        votes = torch.bincount(self.image[self.index.nearest(descriptors[voters], 1, cells=1)[1][:, 0]])
        most = int(votes.max()) if len(votes) else 0
        if most < LEAST_VOTES:
            return None
        similar = (votes >= 0.3 * most).nonzero()[:, 0].tolist()
        shown = torch.cat([self.landmark[self.first[i] : self.first[i + 1]] for i in similar]).unique().long()
        return shown if 5 * len(shown) <= MANY_LANDMARKS else None  # comparing more takes longer than searching cells


class LandmarkMatcher:
    """Finds the landmarks whose descriptors are nearest to given keypoint descriptors.

    Above a few thousand landmarks, it uses an inverted file: only the ``LandmarkMap.descriptor_cells`` nearest to a keypoint are searched
    (Sivic and Zisserman 2003; Jegou et al. 2011). Threads may share a matcher. The matcher also computes ``LandmarkMap.cells`` for
    matching by projection.

    Descriptors are compared on the device of the descriptors of ``landmarks``; all other computations with landmarks run on the CPU. On an
    accelerator the search is always exhaustive.
    """

    def __init__(self, landmarks: LandmarkMap) -> None:
        self.landmarks = landmarks.to("cpu")
        _ = self.landmarks.cells  # computed now and cached, as threads may share the matcher
        self._descriptors = landmarks.descriptors
        self._cached_features: CachedFeatures | None = None  # see ``for_query``
        # None: the search is exhaustive.
        self._index: HalfPrecisionSearch | InvertedFile | None = None
        self._places: Places | None = None
        if self.device.type != "cpu":
            self._index = HalfPrecisionSearch(landmarks.descriptors)
        elif len(landmarks) > FEW_DESCRIPTORS:
            cells = landmarks.descriptor_cells or DescriptorCells.of(landmarks.descriptors)
            self._index = InvertedFile(landmarks.descriptors, cells)
            self._places = Places.of(landmarks, self._index)

    @property
    def device(self) -> torch.device:
        """The device of the given landmarks, on which descriptors are compared."""
        return self._descriptors.device

    @property
    def features(self) -> Features:
        """The keypoint detector and descriptor that the landmarks were built with.

        Raises ``PluginError`` (an ``InputError``) if its plugin is not installed.
        """
        return self._cached_features or find_features(self.landmarks.features, "the detector of the map's landmarks")

    def for_query(self, features: CachedFeatures | None = None) -> LandmarkMatcher:
        """Return a matcher for one query, whose ``features`` cache the keypoints of each image; everything else is shared.

        The matchers of several maps may share the ``features`` too, if their landmarks have the same detector.
        """
        found = copy.copy(self)
        found._cached_features = features or CachedFeatures(lambda rgb: detect(self.features, rgb))
        return found

    def nearest(self, descriptors: UInt8[Tensor, "q d"], count: int) -> tuple[Float[Tensor, "q k"], Int[Tensor, "q k"]]:
        """Return the squared distances and the indices of the ``count`` nearest landmarks, nearest first.

        With fewer landmarks, missing distances are infinite and missing indices 0. Both results are on the CPU. Raises ``InputError`` if
        the number of channels differs from that of the map's descriptors.
        """
        channels = self._descriptors.shape[1]
        if descriptors.shape[1] != channels:
            raise InputError(
                f"the map's descriptors have {channels} channels, those of the image {descriptors.shape[1]}; "
                "use the detector with which the map was baked, or bake it again"
            )
        shown = None if self._places is None else self._places.shown(descriptors)
        # Comparing up to four million pairs is faster than searching cells.
        few = len(descriptors) * len(self.landmarks) <= 4_000_000
        if shown is not None:
            distance, column = smallest(squared_distances(descriptors, self._descriptors[shown]), count)
            landmark = shown[column]
        elif self._index is None or (few and isinstance(self._index, InvertedFile)):
            distance, landmark = smallest(squared_distances(descriptors, self._descriptors), count)
        else:
            distance, landmark = self._index.nearest(descriptors.to(self.device), count)
        missing = (0, count - distance.shape[1])
        return pad(distance, missing, value=torch.inf), pad(landmark, missing)


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
    ambiguity: Float[Tensor, "k"]  # ratio of the distances of the best landmark and the best one at another place

    @staticmethod
    def of(query: QueryKeypoints, matcher: LandmarkMatcher, strongest: int) -> Nearest:
        landmarks = matcher.landmarks
        first = torch.searchsorted(query.view, query.view)
        strongest = strongest if len(landmarks) else 0
        keypoint = (torch.arange(len(query.view)) - first < strongest).nonzero()[:, 0]
        distance, index = matcher.nearest(query.keypoints.descriptors[keypoint], 4)
        position, size = landmarks.positions[index], landmarks.sizes[index]
        away = (position - position[:, :1]).norm(dim=-1)
        same = away <= 2 * torch.maximum(size, size[:, :1]) + 3 * landmarks.deviations[index].amax(-1)
        other = torch.where(same, torch.inf, distance).amin(1)
        other = torch.where(other.isfinite(), other, distance[:, -1])
        return Nearest(keypoint, distance, index, (distance[:, 0] / other.clamp(min=1)).sqrt().nan_to_num(1.0))

    @property
    def best(self) -> Matches:
        """The unambiguous matches, supplemented by ambiguous ones if there are few."""
        order = self.ambiguity.argsort(stable=True)
        # Ambiguous matches are added until there are 60.
        count = max(60, int((self.ambiguity <= AMBIGUITY).sum()))  # host
        return Matches(self.keypoint[order[:count]], self.landmark[order[:count], 0])

    def others(self, near: Bool[Tensor, "k n"]) -> Matches:
        """Return matches with landmarks about as similar as the nearest one, except those that a pose projects close by (``near``)."""
        ratio = self.distance / self.distance[:, :1].clamp(min=1)
        row, column = ((ratio <= AMBIGUITY**-2) & ~near & self.distance.isfinite()).nonzero().unbind(-1)  # host
        order = (self.distance[row, column]).argsort(stable=True)
        return Matches(self.keypoint[row[order]], self.landmark[row, column][order])


class Projected:
    """The landmarks that should be visible from one state, with their projections, view by view."""

    def __init__(
        self,
        query: QueryKeypoints,
        landmarks: LandmarkMap,
        state: States,
        margin: float,
        among: Projected | None = None,
    ) -> None:
        """Project landmarks up to ``margin`` pixels beyond the image edges, optionally only ``among`` those visible from a nearby pose."""
        self.query, self.landmarks, self.visible = query, landmarks, 0
        # For each view: its keypoints, the landmarks, its focal length, their expected sizes in pixels, and a tree of their projections.
        self._parts: list[tuple[Tensor, Tensor, float, Tensor, cKDTree | None]] = []
        nuisances = state.nuisances[0]
        zoom = float(nuisances[0].exp())  # host
        for number, image in enumerate(query.images):
            c, own = image.intrinsics, (query.view == number).nonzero()[:, 0]
            T = state.T[0] @ image.T_ref_camera
            if among is None:
                half = torch.tensor([max(c.cx, c.width - c.cx) / c.fx, max(c.cy, c.height - c.cy) / c.fy])
                slopes = (1.2 * (half + nuisances[1:3].abs().float()) + margin / image.focal) / zoom
                sizes = query.keypoints.sizes[own]
                smallest = float(sizes.min()) / (2**OCTAVES * image.focal * zoom) if len(sizes) else 0.0
                index, _ = landmarks.in_view(T, slopes, OBLIQUE, smallest)
            else:
                index = among._parts[number][1]
            local = T.inverse().apply(landmarks.positions[index].double())
            index, local = index[local[:, 2] > 0], local[local[:, 2] > 0]
            scale = torch.tensor([c.fx, c.fy], dtype=torch.float64)
            centre = torch.tensor([c.cx, c.cy], dtype=torch.float64)
            flat = imaged(state, local[None], local.new_zeros(len(local))).image[0]
            if bool((nuisances[6:12] != 0).any()):
                flat = imaged(state, local[None], exposure_times(flat * scale + centre, c)).image[0]
            shown = flat * scale + centre
            inside = ((shown > 0) & (shown < torch.tensor([c.width, c.height]))).all(-1)
            if image.hidden is not None:
                column, row = shown[inside].long().unbind(-1)
                inside[inside.clone()] = ~image.hidden[row, column]
            self.visible += int(inside.sum())
            expected = landmarks.sizes[index] * (image.focal * zoom) / local[:, 2]
            tree = cKDTree((flat * image.focal).numpy(), balanced_tree=False) if len(index) else None  # host
            self._parts.append((own, index, image.focal, expected, tree))

    def matches(self, radius: float, shift: float = 0.0) -> Matches:
        """Return the matches within ``radius`` pixels; if keypoints are displaced by ``shift`` (pixels), all matches are due to chance."""
        query, landmarks = self.query, self.landmarks
        pairs = []
        for own, index, focal, expected, tree in self._parts:
            if tree is None or not len(own):
                continue
            observed = query.sights.image[own] * focal + shift
            _, found = tree.query(
                observed.numpy(), 6, distance_upper_bound=radius, workers=torch.get_num_threads()
            )  # host
            found = torch.from_numpy(np.asarray(found, dtype=np.int64).reshape(len(own), -1))
            row, column = (found < len(index)).nonzero().unbind(-1)
            candidate = found[row, column]
            alike = (expected[candidate] / query.keypoints.sizes[own[row]]).log2().abs() <= OCTAVES
            pairs.append(torch.stack([own[row], index[candidate]])[:, alike])
        keypoint, landmark = torch.cat([torch.zeros((2, 0), dtype=torch.long), *pairs], 1)
        distance = paired_squared_distances(query.keypoints.descriptors, landmarks.descriptors, keypoint, landmark)
        # Descriptors of a match are at most 0.6 times as far from each other as unrelated ones.
        most = (0.6 * landmarks.unrelated_distance) ** 2
        q = len(query.view)
        best = torch.full((q,), torch.inf).scatter_reduce_(0, keypoint, distance, "amin")
        is_best = distance == best[keypoint]
        second = torch.full((q,), most / AMBIGUITY**2)
        second = second.scatter_reduce_(0, keypoint[~is_best], distance[~is_best], "amin")
        good = is_best & (distance <= most) & (distance <= AMBIGUITY**2 * second[keypoint])
        keypoint, landmark, distance = keypoint[good], landmark[good], distance[good]
        # Each view observes a landmark at most once.
        key = query.view[keypoint] * len(landmarks) + landmark
        least = torch.full((len(query.images) * len(landmarks),), torch.inf).scatter_reduce_(0, key, distance, "amin")
        once = distance == least[key]
        return Matches(keypoint[once], landmark[once])


def log10_nfa(matches: int, agreeing: int, probability: float) -> float:
    """Return log10 of the number of false alarms (Moisan and Stival 2004, eq. 10).

    This is the expected number of poses with ``agreeing`` inliers if all ``matches`` are wrong and each is an inlier with
    ``probability``; ``SAMPLE`` matches determine a pose.
    """
    if agreeing <= SAMPLE:
        return 0.0

    def log_binomial(n: int, k: int) -> float:
        return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)

    log = math.log(max(1, matches - SAMPLE)) + log_binomial(matches, agreeing) + log_binomial(agreeing, SAMPLE)
    return (log + (agreeing - SAMPLE) * math.log(probability)) / math.log(10)
