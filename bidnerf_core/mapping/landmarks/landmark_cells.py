"""Cells of neighbouring landmarks, for finding those in a camera's view without testing every landmark."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf_core.geometry import SE3

MOST_IN_CELL = 128
"""Maximum number of landmarks in a cell."""


@dataclass(frozen=True, eq=False)
class LandmarkCells:
    """Leaves of a k-d tree over landmarks, each with its bounding ball and the cone of viewing directions."""

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
        apart = 1.001 * np.linalg.norm(points - centres[cell], axis=-1) + rounding
        angle = np.arccos((towards * mean.numpy()[cell]).sum(-1).clip(-1, 1)) + cones.numpy()[order]
        radii, widest, largest = (
            torch.from_numpy(np.maximum.reduceat(of, first)) for of in (apart, angle, sizes.numpy()[order])
        )
        return LandmarkCells(
            torch.from_numpy(order), torch.from_numpy(first), torch.from_numpy(counts), torch.from_numpy(centres),
            radii, mean, widest.clamp(max=torch.pi), largest,
        )  # fmt: skip

    def seen_from(
        self, T_world_camera: SE3, slopes: Float[Tensor, "2"], oblique: float, size: float = 0.0
    ) -> Int[Tensor, "m"]:
        """Return the indices of the landmarks in all cells that may be visible in an image, in no particular order.

        A landmark is visible if ``|x| <= slopes[0] z`` and ``|y| <= slopes[1] z`` in the camera's frame, the camera is at
        most ``oblique`` (radians) outside the cone of the landmark's viewing directions, and the landmark is not smaller than
        ``size`` z.
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
        kept = (inside & facing & large).nonzero()[:, 0]
        counts = self.counts[kept]
        start = self.first[kept] - counts.cumsum(0) + counts
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
