"""Occluders: the nearest segment of a depth image, cut out along depth discontinuities."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.by_surface import ON_SURFACE, SIGHT_LINES
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.settings import LEAST_POINTS
from bidnerf_core.mapping import SurfaceMap, cast


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
        lines = (T.apply(self.points.to(T.translation)) - T.translation).float()
        length = torch.linalg.vector_norm(lines, dim=-1)
        met = cast(surface, T.translation.float().expand_as(lines), lines / length[:, None])
        before = ~met.met | (length < met.along - ON_SURFACE * surface.extent)
        return float(before.float().mean())


def nearest_piece(problem: Problem) -> Occluder | None:
    """Return the segment of a single depth image that may be an occluder: the nearest large one.

    None if there is no such segment, if nothing else was measured, or if there are several images or other sensors.
    """
    view = problem.views[-1]
    if len(problem.views) != 1 or problem.depth_rays is not None or view.frame.depth is None:
        return None
    depth = view.frame.depth.cpu().numpy()
    number, measured = np.arange(depth.size).reshape(depth.shape), (depth > 0) & np.isfinite(depth)
    values, pairs = np.where(measured, depth, 0), []
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        near, far = np.minimum(values[a], values[b]), np.maximum(values[a], values[b])
        # Relative depth difference above which neighbouring pixels belong to different segments
        joined = (near > 0) & (far - near <= 0.05 * near)
        pairs.append(np.stack([number[a][joined], number[b][joined]]))
    first, second = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(first), dtype=bool), (first, second)), shape=(depth.size, depth.size))
    label = connected_components(graph, directed=False)[1].reshape(depth.shape)
    counts = np.bincount(label[measured], minlength=1)
    total = counts.sum()
    # Neither the occluder nor the rest may be small.
    pieces = (counts >= max(LEAST_POINTS, 0.15 * total)).nonzero()[0]
    if len(pieces) == 0:
        return None
    nearest = min(pieces, key=lambda piece: float(np.median(values[measured & (label == piece)])))
    if total - counts[nearest] < max(LEAST_POINTS, 0.05 * total):
        return None
    piece = torch.from_numpy(measured & (label == nearest))
    hidden, given = piece.to(view.frame.depth.device), view.frame.hidden
    frame = view.frame.replace(
        depth=torch.where(hidden, 0, view.frame.depth), hidden=hidden if given is None else hidden | given
    )
    pixels = piece.nonzero()
    some = pixels[torch.linspace(0, len(pixels) - 1, min(len(pixels), SIGHT_LINES)).long()]
    along = torch.from_numpy(values).double()[some[:, 0], some[:, 1], None]
    points = view.frame.intrinsics.unproject(some.flip(-1).double() + 0.5) * along
    rest = replace(problem, views=(replace(view, frame=frame),))
    return Occluder(rest, len(pixels) / int(total), points.float())
