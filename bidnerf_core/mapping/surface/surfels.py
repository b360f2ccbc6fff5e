"""Surfels: small discs of a surface, fused from points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

SURFEL_NEIGHBOURS = 12
"""Number of surfels to which the plane and the colour gradient of each surfel are fitted."""


@dataclass(frozen=True, eq=False)
class Surfels:
    """Points of a surface with its normals and colours there. World frame, metres."""

    positions: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]  # unit; their sign has no meaning
    rgb: Float[Tensor, "n 3"]
    rgb_gradient: Float[Tensor, "n 3 3"]  # channel by axis, per metre, within the plane

    def __len__(self) -> int:
        return len(self.positions)


def surfel_bytes(count: int) -> int:
    """Return the memory that ``count`` surfels take: 18 numbers of 4 bytes each."""
    return 72 * count


def merged(cells: Int[Tensor, "p"], *values: Float[Tensor, "p _"]) -> tuple[Int[Tensor, "n"], list[Tensor]]:
    """Return which cells hold points, in ascending order, and the means of the points' ``values`` in each of them."""
    found, place, counts = cells.unique(return_inverse=True, return_counts=True)
    means = [
        torch.zeros((len(found), v.shape[-1]), dtype=v.dtype).index_add_(0, place, v) / counts[:, None]
        for v in values
    ]
    return found, means


def fused_surfels(positions: Float[Tensor, "n 3"], rgb: Float[Tensor, "n 3"]) -> Surfels:
    """Return surfels of merged points: fit a plane to the neighbours of each point and move it onto that plane."""
    near = _neighbours(positions, SURFEL_NEIGHBOURS)
    offsets = positions[near] - positions[:, None]
    mean = offsets.mean(1)
    centred = offsets - mean[:, None]
    _, axes = torch.linalg.eigh(centred.mT @ centred)
    normals = axes[..., 0]
    positions = positions + normals * (normals * mean).sum(-1, keepdim=True)
    return Surfels(positions, normals, rgb[near].mean(1), _gradient(centred, normals, rgb[near]))


def _neighbours(positions: Float[Tensor, "n 3"], count: int) -> Int[Tensor, "n k"]:
    """Return the indices of each point's nearest points, itself among them."""
    points = positions.numpy()
    _, index = cKDTree(points).query(points, k=min(count, len(points)), workers=-1)
    return torch.from_numpy(np.asarray(index, dtype=np.int64).reshape(len(points), -1))


def _gradient(
    offsets: Float[Tensor, "n k 3"], normals: Float[Tensor, "n 3"], rgb: Float[Tensor, "n k 3"]
) -> Float[Tensor, "n 3 3"]:
    """Return the least-squares gradient of colour within the plane.

    See Park et al. 2017, "Colored point cloud registration", eq. 10.
    """
    flat = offsets - (offsets * normals[:, None]).sum(-1, keepdim=True) * normals[:, None]
    spread = flat.mT @ flat
    size = spread.diagonal(dim1=-2, dim2=-1).sum(-1).clamp(min=torch.finfo(flat.dtype).tiny)
    # Any weight along the normal makes the gradient 0 there; a little weight everywhere regularizes thin strips.
    held = normals[:, :, None] * normals[:, None] + 0.02 * torch.eye(3)
    system = spread / size[:, None, None] + held
    seen = flat.mT @ (rgb - rgb.mean(1, keepdim=True)) / size[:, None, None]
    return torch.linalg.solve(system, seen).mT
