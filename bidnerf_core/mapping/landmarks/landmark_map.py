"""Landmarks: points of the scene with descriptors, by which they are recognised in images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.devices import move_to, working_device
from bidnerf_core.geometry import KEYPOINTS_PER_INDEPENDENT, SE3
from bidnerf_core.mapping.landmarks.descriptors import (
    FEW_DESCRIPTORS,
    DescriptorCells,
    nearest_centre,
    unrelated_distance,
)
from bidnerf_core.mapping.landmarks.features import USUAL_FEATURES
from bidnerf_core.settings import Degrees, Length, NotNegative, Positive, Settings, WholeNumber

MOST_IN_CELL = 128
"""Maximum number of landmarks in a cell."""
FEW = 20_000
"""The number of landmarks up to which testing all of them is faster than finding the cells in view."""


@dataclass(frozen=True)
class HeldOutTrial(Settings):
    """Accuracy with which images of the map were localized by landmarks that were built without these images."""

    images: WholeNumber = 0
    found: WholeNumber = 0  # number of these images whose pose was found
    translation: Length = 0.0  # metres: median error
    rotation_deg: Degrees = 0.0
    # Factors by which the information of points on the surface and of rendered rays exceeds that of independent measurements.
    # They are unknown for points in a map without measured depth, whose surface has the errors of the field's depth.
    points: Positive = 10.0
    rays: Positive = 3.0
    difference: NotNegative = (
        0.0  # usual mean loss of rays at a right pose, in squares of the loss's scale; 0 if unknown
    )
    # Factor on the predicted covariance of a pose after which a Gaussian's 95 % ellipsoid holds 95 % of the errors
    tails: Positive = 1.7

    def scaled(self, factor: float) -> HeldOutTrial:
        """Return the trial in a map with lengths multiplied by ``factor``."""
        return replace(self, translation=self.translation * factor)


@dataclass(frozen=True, eq=False)
class Tracks:
    """The keypoints of a map's images from which its landmarks were built."""

    landmark: Int[Tensor, "m"]  # number of the landmark, int32
    image: Int[Tensor, "m"]  # number of the image among the cameras of the map, int32
    pixel: Float[Tensor, "m 2"]  # in the image

    def renumber(self, landmarks: Int[Tensor, "n"] | None = None, images: Int[Tensor, "v"] | None = None) -> Tracks:
        """Renumber the landmarks and images, given the new number for each old one; keypoints whose new number is -1 are dropped."""
        landmark = self.landmark if landmarks is None else landmarks.int()[self.landmark.long()]
        image = self.image if images is None else images.int()[self.image.long()]
        known = (landmark >= 0) & (image >= 0)
        return Tracks(landmark[known], image[known], self.pixel[known])


@dataclass(frozen=True, eq=False)
class LandmarkCells:
    """Leaves of a k-d tree over landmarks, each with a bounding ball of its landmarks and a cone of their viewing directions."""

    order: Int[Tensor, "n"]  # indices of the landmarks, cell by cell
    first: Int[Tensor, "c"]  # position of a cell's first landmark in ``order``
    counts: Int[Tensor, "c"]
    centres: Float[Tensor, "c 3"]
    radii: Float[Tensor, "c"]  # metres
    directions: Float[Tensor, "c 3"]  # unit
    cones: Float[Tensor, "c"]  # radians: largest angle between ``directions`` and a camera
    sizes: Float[Tensor, "c"]  # metres: size of the largest landmark

    @staticmethod
    def of(
        positions: Float[Tensor, "n 3"],
        directions: Float[Tensor, "n 3"],
        cones: Float[Tensor, "n"],
        sizes: Float[Tensor, "n"],
    ) -> LandmarkCells:
        """Sort landmarks into cells; all tensors are as in ``LandmarkMap``."""
        tree = cKDTree(positions.numpy(), leafsize=MOST_IN_CELL)
        bounds = np.array(list(_leaves(tree.tree)), dtype=np.int64)
        first, counts, order = bounds[:, 0], bounds[:, 1] - bounds[:, 0], tree.indices
        cell = np.repeat(np.arange(len(counts)), counts)
        points, towards = positions.numpy()[order], directions.numpy()[order]
        centres = np.add.reduceat(points, first) / counts[:, None].astype(np.float32)
        mean = torch.nn.functional.normalize(torch.from_numpy(np.add.reduceat(towards, first)), dim=-1)
        rounding = 1e-6 * np.abs(points).max()
        reach = 1.001 * np.linalg.norm(points - centres[cell], axis=-1) + rounding
        angle = np.arccos((towards * mean.numpy()[cell]).sum(-1).clip(-1, 1)) + cones.numpy()[order]
        radii, widest, largest = (
            torch.from_numpy(np.maximum.reduceat(of, first)) for of in (reach, angle, sizes.numpy()[order])
        )
        return LandmarkCells(
            torch.from_numpy(order),
            torch.from_numpy(first),
            torch.from_numpy(counts),
            torch.from_numpy(centres),
            radii,
            mean,
            widest.clamp(max=torch.pi),
            largest,
        )

    def seen_from(
        self, T_world_camera: SE3, slopes: Float[Tensor, "2"], oblique: float, size: float = 0.0
    ) -> Int[Tensor, "m"]:
        """Return the indices of the landmarks in all cells that may be visible in an image, in no particular order.

        A landmark is visible if ``|x| <= slopes[0] z`` and ``|y| <= slopes[1] z`` in the camera's frame, the camera is at most ``oblique``
        (radians) outside the cone of the landmark's viewing directions, and the landmark's size is at least ``size`` times z.
        """
        local = T_world_camera.inverse().to(torch.float32).apply(self.centres)
        beyond = (local[:, :2].abs() - slopes * local[:, 2:]) / (1 + slopes.square()).sqrt()
        inside = (beyond <= self.radii[:, None]).all(-1) & (local[:, 2] > -self.radii)
        distance = torch.linalg.vector_norm(local, dim=-1)
        towards = T_world_camera.translation.float() - self.centres
        angle = ((towards * self.directions).sum(-1) / distance.clamp(min=1e-12)).clamp(-1, 1).acos()
        swing = (self.radii / distance.clamp(min=1e-12)).clamp(max=1).asin()
        facing = (angle <= self.cones + oblique + swing + 1e-3) | (distance <= self.radii)
        large = self.sizes >= size * (local[:, 2] - self.radii)
        visible = (inside & facing & large).nonzero()[:, 0]
        counts = self.counts[visible]
        start = self.first[visible] - counts.cumsum(0) + counts
        return self.order[torch.arange(int(counts.sum())) + start.repeat_interleave(counts)]


def _leaves(node: object) -> Iterator[tuple[int, int]]:
    """Yield the start and end of each leaf of scipy's k-d tree."""
    left: list[object] = [node]
    while left:
        node = left.pop()
        if node.split_dim < 0:  # type: ignore[attr-defined]
            yield node.start_idx, node.end_idx  # type: ignore[attr-defined]
        else:
            left += [node.greater, node.lesser]  # type: ignore[attr-defined]


@dataclass(frozen=True, eq=False)
class LandmarkMap:
    """The landmarks of a map: points in the world frame (metres) with descriptors."""

    positions: Float[Tensor, "n 3"]
    deviations: Float[Tensor, "n 2"]  # metres: standard deviation across and along ``directions``
    descriptors: UInt8[Tensor, "n d"]  # mean over the views; see ``mapping.landmarks.features``
    directions: Float[Tensor, "n 3"]  # unit, from the landmark: the mean direction to the cameras that observed it
    cones: Float[Tensor, "n"]  # radians: largest angle between ``directions`` and such a camera
    sizes: Float[Tensor, "n"]  # metres: diameter of the keypoint, measured at its distance
    views: Int[Tensor, "n"]  # number of images that observed it, int32
    noise: float  # pixels: standard deviation of a keypoint along each axis, in the images of the map
    # Covariance of the right updates (metres, then radians) from the given poses of the map's images to those by resection,
    # including those of pose refinement in training: the error of the pose source.
    pose_covariance: Float[Tensor, "6 6"]  # float64
    # Number of keypoints that count as one measurement, because their errors are correlated, in an image with
    # ``usual_matches`` of them; see ``correlation_of``.
    correlation: float = KEYPOINTS_PER_INDEPENDENT
    usual_matches: float = 0.0  # median over the images of the map; 0 if unknown
    # Standard deviations of the spurious corrections to right intrinsics that are estimated from images of the map:
    # logarithm of the focal length, principal point (u, v) as a fraction of it, radial distortion. Float64.
    calibration_scatter: Float[Tensor, "4"] = field(default_factory=lambda: torch.full((4,), 0.02, dtype=torch.float64))
    trial: HeldOutTrial = HeldOutTrial()
    moving: float = 0.0  # fraction of the map's images whose cameras moved during readout, see ``rolling_shutter``
    cameras: tuple[Intrinsics, ...] = ()  # of the images, where known
    features: str = USUAL_FEATURES  # name of the detector of the keypoints; "" if it has none
    tracks: Tracks | None = None  # None in maps that earlier versions stored
    descriptor_cells: DescriptorCells | None = None  # None for few landmarks, and in maps that earlier versions stored

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: Tensor | slice) -> LandmarkMap:
        tracks = self.tracks
        if tracks is not None:
            there = tracks.landmark.device
            chosen = torch.arange(len(self), device=there)[index]
            numbers = torch.full((len(self),), -1, device=there)
            numbers[chosen] = torch.arange(len(chosen), device=there)
            tracks = tracks.renumber(numbers)
        cells = None if self.descriptor_cells is None else self.descriptor_cells[index]
        parts = {name: getattr(self, name)[index] for name in PER_LANDMARK}
        return replace(self, tracks=tracks, descriptor_cells=cells, **parts)

    def indexed(self) -> LandmarkMap:
        """Return the landmarks in the order of new cells of their descriptors; ``self`` if they are few."""
        if len(self) <= FEW_DESCRIPTORS:
            return self
        cells = DescriptorCells.of(self.descriptors)
        return replace(self, descriptor_cells=cells)[cells.cell.argsort(stable=True)]

    def scaled(self, factor: float) -> LandmarkMap:
        """Return the landmarks with lengths multiplied by ``factor``."""
        lengths = self.pose_covariance.new_tensor([factor] * 3 + [1.0] * 3)
        return replace(
            self,
            positions=self.positions * factor,
            deviations=self.deviations * factor,
            sizes=self.sizes * factor,
            pose_covariance=self.pose_covariance * torch.outer(lengths, lengths),
            trial=self.trial.scaled(factor),
        )

    def to(self, device: torch.device | str) -> LandmarkMap:
        """Return the landmarks on another device; ``self`` if they are already there.

        Only descriptor matching runs on that device. Keypoint detection, RANSAC and resection run on the CPU (OpenCV, poselib,
        scipy), so ``LandmarkMatcher`` also keeps the landmarks in CPU memory.
        """
        return move_to(self, working_device(device))

    def correlation_of(self, matches: int) -> float:
        """Return how many keypoints amount to one independent measurement in an image with ``matches`` matched keypoints.

        Errors of neighbouring keypoints are correlated, and images with many matches have more neighbours. On several captures, the number
        grew with the square root of the number of matches.
        """
        if self.usual_matches <= 0:
            return self.correlation
        return 1 + max(self.correlation - 1, 0.0) * math.sqrt(matches / self.usual_matches)

    @cached_property
    def unrelated_distance(self) -> float:
        """The root mean square distance between descriptors of different landmarks, the unit of distance thresholds."""
        return unrelated_distance(self.descriptors)

    @cached_property
    def cells(self) -> LandmarkCells | None:
        """The cells of the landmarks, on the CPU (computing them takes a second for a million landmarks); None for few landmarks."""
        return LandmarkCells.of(self.positions, self.directions, self.cones, self.sizes) if len(self) > FEW else None

    def in_view(
        self, T_world_camera: SE3, slopes: Float[Tensor, "2"], oblique: float, size: float = 0.0
    ) -> tuple[Int[Tensor, "m"], Float[Tensor, "m 3"]]:
        """Return the numbers of the landmarks visible in an image, ignoring occlusion, and their positions in the camera's frame.

        The conditions and the arguments are those of ``LandmarkCells.seen_from``.
        """
        cells = self.cells
        index = torch.arange(len(self)) if cells is None else cells.seen_from(T_world_camera, slopes, oblique, size)
        local = T_world_camera.inverse().to(torch.float32).apply(self.positions[index])
        inside = (local[:, :2].abs() <= slopes * local[:, 2:]).all(-1) & (local[:, 2] > 0)
        inside &= self.sizes[index] >= size * local[:, 2]
        index, local = index[inside], local[inside]
        towards = T_world_camera.translation.float() - self.positions[index]
        cosine = (towards * self.directions[index]).sum(-1) / towards.norm(dim=-1).clamp(min=1e-12)
        facing = cosine >= (self.cones[index] + oblique).clamp(max=torch.pi).cos()
        return index[facing], local[facing]

    @property
    def megabytes(self) -> float:
        """The size of the landmarks' tensors in megabytes (10^6 bytes)."""
        return sum(getattr(self, name).nbytes for name in PER_LANDMARK) / 1e6


PER_LANDMARK = ("positions", "deviations", "descriptors", "directions", "cones", "sizes", "views")
"""The tensors of a map that have one row per landmark."""


def concatenate(maps: list[LandmarkMap]) -> LandmarkMap:
    """Return the landmarks of all ``maps`` (descriptors of the same length), with the other fields of the first map.

    Their descriptors are divided into the cells of the first map, if it has any.
    """
    joined: dict[str, Any] = {name: torch.cat([getattr(m, name) for m in maps]) for name in PER_LANDMARK}
    firsts = accumulate(map(len, maps), initial=0)
    numbered = [(m.tracks, torch.arange(len(m)) + first) for m, first in zip(maps, firsts, strict=False)]
    tracks = [part.renumber(numbers) for part, numbers in numbered if part is not None]
    if tracks:
        parts = (torch.cat([getattr(part, name) for part in tracks]) for name in ("landmark", "image", "pixel"))
        joined["tracks"] = Tracks(*parts)
    if (cells := maps[0].descriptor_cells) is not None:
        more = [nearest_centre(m.descriptors, cells.centres).int() for m in maps[1:]]
        joined["descriptor_cells"] = replace(cells, cell=torch.cat([cells.cell, *more]))
    return replace(maps[0], **joined)
