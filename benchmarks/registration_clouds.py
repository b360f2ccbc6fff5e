"""The inputs of point cloud registration: the points of a baked map, and those that a frame measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bidnerf_core.frames.frame import Frame, View
from bidnerf_core.frames.pixels import observe
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.mapping.casting import trace

WITNESSES = 24
"""Number of keyframes that vote on the outward side of surfels."""


@dataclass(frozen=True, eq=False)
class Points:
    """Points in one frame of reference, float64 as the libraries require."""

    positions: NDArray[np.float64]  # (n, 3), metres
    rgb: NDArray[np.float64]  # (n, 3), 0 to 1
    normals: NDArray[np.float64] | None = None  # (n, 3), unit, outwards


def map_points(surface: SurfaceMap) -> Points:
    """Return the surfels, with normals towards the side they were seen from: feature histograms depend on that."""
    surfels = surface.surfels
    normals = surfels.normals * _outwards(surface)[:, None]
    return Points(*(part.double().numpy() for part in (surfels.positions, surfels.rgb, normals)))


def measured_points(frame: Frame) -> Points:
    """Return the points of all pixels that have a depth, in the frame of the camera."""
    assert frame.depth is not None
    rows, columns = (frame.depth > 0).nonzero().unbind(-1)
    seen = observe(View(frame, SE3.identity()), torch.stack([columns, rows], dim=-1), torch.float64)
    return Points((seen.distance[:, None] * seen.directions).numpy(), seen.rgb.numpy())


def _outwards(surface: SurfaceMap) -> torch.Tensor:
    """Return 1 or -1 for each surfel: the side of most keyframes that see it or, if none sees it, of most keyframes."""
    keyframes = surface.keyframes[:: max(1, len(surface.keyframes) // WITNESSES)]
    votes = torch.zeros((2, len(surface.surfels)))
    for centre in keyframes[:, :3, 3].to(surface.surfels.positions):
        way = surface.surfels.positions - centre
        length = torch.linalg.vector_norm(way, dim=-1)
        directions = way / length[:, None]
        met = trace(surface, centre.expand_as(directions), directions)
        side = -(directions * surface.surfels.normals).sum(-1).sign()
        votes += torch.stack([side * (met > length - 2 * surface.cell), side])
    decided = torch.where(votes[0] != 0, votes[0], votes[1])
    return torch.where(decided < 0, -1.0, 1.0)
