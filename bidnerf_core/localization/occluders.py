"""Occluders: the nearest segment of a depth image, cut out along depth discontinuities."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.by_surface import SIGHT_LINES
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.settings import LEAST_POINTS
from bidnerf_core.mapping import SurfaceMap, cast

JUMP = 0.05
"""Relative depth difference above which neighbouring pixels belong to different segments."""
CONSIDERABLE, REST = 0.15, 0.05
"""Minimum fraction of the measured pixels in an occluder, and in the rest."""
CLEARLY_IN_FRONT = 0.02
"""Distance in front of the surface (fraction of the scene's extent) up to which a point still lies on it."""


@dataclass(frozen=True, eq=False)
class Occluder:
    """The nearest large segment of a depth image, and the problem without its pixels."""

    rest: Problem
    share: float  # its fraction of the measured pixels
    points: Float[Tensor, "n 3"]  # some of its points, in the camera's frame, metres

    @torch.no_grad()
    def share_in_front(self, surface: SurfaceMap, T_world_camera: SE3) -> float:
        """Return the fraction of its points clearly in front of the surface, or of empty space, as seen from a pose."""
        T = T_world_camera.to(surface.device)
        ends = T.apply(self.points.to(T.translation))
        lines = (ends - T.translation).float()
        length = torch.linalg.vector_norm(lines, dim=-1)
        met = cast(surface, T.translation.float().expand_as(lines), lines / length[:, None])
        before = ~met.met | (length < met.along - CLEARLY_IN_FRONT * surface.extent)
        return float(before.float().mean())


def nearest_piece(problem: Problem) -> Occluder | None:
    """Return the segment of a single depth image that may be an occluder: the nearest large one.

    None if there is no such segment, if nothing else was measured, or if there are several images or other sensors.
    """
    if len(problem.views) != 1 or problem.depth_rays is not None:
        return None
    (view,) = problem.views
    depth = view.frame.depth
    if depth is None:
        return None
    piece = _nearest(depth.cpu())
    if piece is None:
        return None
    hidden = piece.to(depth.device)
    given = view.frame.hidden
    frame = view.frame.replace(
        depth=torch.where(hidden, 0, depth), hidden=hidden if given is None else hidden | given
    )
    pixels = piece.nonzero()
    some = pixels[torch.linspace(0, len(pixels) - 1, min(len(pixels), SIGHT_LINES)).long()]
    centres = some.flip(-1).double() + 0.5
    points = view.frame.intrinsics.unproject(centres) * depth.cpu().double()[some[:, 0], some[:, 1], None]
    share = len(pixels) / int(((depth > 0) & depth.isfinite()).sum())
    return Occluder(replace(problem, views=(replace(view, frame=frame),)), share, points.float())


def _nearest(depth: Float[Tensor, "h w"]) -> Bool[Tensor, "h w"] | None:
    label = _pieces(depth.numpy())
    measured = label >= 0
    counts = np.bincount(label[measured]) if measured.any() else np.zeros(0, dtype=int)
    considerable = (counts >= max(LEAST_POINTS, CONSIDERABLE * counts.sum())).nonzero()[0]
    if len(considerable) == 0:
        return None
    values = depth.numpy()
    nearest = min(considerable, key=lambda number: float(np.median(values[label == number])))
    if counts.sum() - counts[nearest] < max(LEAST_POINTS, REST * counts.sum()):
        return None
    return torch.from_numpy(label == nearest)


def _pieces(depth: np.ndarray) -> np.ndarray:
    """Return each pixel's connected segment by number, -1 where nothing was measured."""
    number, measured = np.arange(depth.size).reshape(depth.shape), (depth > 0) & np.isfinite(depth)
    depth = np.where(measured, depth, 0)
    pairs = []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        near, far = np.minimum(depth[a], depth[b]), np.maximum(depth[a], depth[b])
        joined = (near > 0) & (far - near <= JUMP * near)
        pairs.append(np.stack([number[a][joined], number[b][joined]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(depth.size, depth.size))
    _, label = connected_components(graph, directed=False)
    return np.where(measured, label.reshape(depth.shape), -1)
