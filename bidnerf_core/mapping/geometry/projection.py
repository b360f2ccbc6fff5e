"""Pinhole projection of points and its derivatives, for resection, triangulation and bundle adjustment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

Array = np.ndarray

NEAREST = 1e-9
"""Depth (metres) below which a point counts as behind the camera."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Points in the frames of their cameras, projected onto the plane z = 1."""

    front: Array  # (m,) whether the point is in front of its camera; if not, the other fields are meaningless
    flat: Array  # (m, 2) on the plane z = 1
    z: Array  # (m,) metres; 1 behind the camera

    def by_point(self, scale: Array) -> Array:
        """Return the derivatives (m, 2, 3) of ``flat`` times ``scale`` (m) with respect to the points (metres)."""
        (x, y), zero, one = self.flat.T, np.zeros_like(self.z), np.ones_like(self.z)
        rows = np.stack([one, zero, -x, zero, one, -y], axis=1).reshape(-1, 2, 3)
        found: Array = rows * (scale / self.z)[:, None, None]
        return found


def projected(local: Array) -> Projection:
    """Project points (m, 3), given in the frames of their cameras (metres)."""
    front = local[:, 2] > NEAREST
    z = np.where(front, local[:, 2], 1)
    return Projection(front, local[:, :2] / z[:, None], z)


def reprojection_errors(
    local: Float[Tensor, "m 3"], image: Float[Tensor, "m 2"], focal: Float[Tensor, "m"]
) -> Float[Tensor, "m 2"]:
    """Return projection minus observation, pixels; infinite for points behind the camera.

    ``local`` are the points in the frames of their cameras (metres), ``image`` their observations on the plane z = 1.
    """
    found = projected(local.numpy())
    off = (torch.from_numpy(found.flat) - image) * focal[:, None]
    return torch.where(torch.from_numpy(found.front)[:, None], off, torch.inf)


def by_update(by_point: Array, points: Array) -> Array:
    """Return derivatives (m, k, 6) with respect to a right update of a pose (translation first), given those by the points.

    ``points`` (m, 3) are given in the frame of that pose. A point there moves by -rho + p x phi under T exp(rho, phi), and
    r (p x phi) = (r x p) phi.
    """
    return np.concatenate([-by_point, _cross(by_point, points[:, None])], axis=-1)


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product along the last axis; ``np.cross`` takes five times as long for small arrays."""
    (a0, a1, a2), (b0, b1, b2) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=-1)
