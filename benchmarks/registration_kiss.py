"""Registration of point clouds without a start by KISS-Matcher (Lim et al. 2025)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from registration_clouds import Points
from registration_methods import Gicp, Matrix, SmallGicp
from registration_tuning import Case, Score, scored, timed

FEWEST_INLIERS = 5
"""Number of inliers from which the library's own example considers a registration successful."""


class KissMatcher:
    """Registration of frames to a map. The library computes the map's descriptors anew for each frame."""

    def __init__(self, points: Points) -> None:
        import kiss_matcher

        self.library: Any = kiss_matcher
        self.positions = points.positions.astype(np.float32)

    def search(self, measured: Points, voxel: float) -> tuple[Matrix, bool]:
        """Return T_world_camera and whether enough matches agree with it. ``voxel`` is in metres."""
        matcher = self.library.KISSMatcher(self.library.KISSMatcherConfig(voxel))
        found = matcher.estimate(measured.positions.astype(np.float32), self.positions)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = found.rotation, np.ravel(found.translation)
        return T, matcher.get_num_final_inliers() >= FEWEST_INLIERS


def tuned_kiss(
    library: KissMatcher, gicp: SmallGicp, tries: Sequence[Case], voxel: float
) -> tuple[float, list[Matrix]]:
    """Return the voxel size with which most frames are localized after refinement by GICP, and the poses before it."""
    rough = Gicp(voxel / 2, (2 * voxel, voxel))

    def search(size: float) -> tuple[Score, list[Matrix]]:
        found, seconds = timed(tries, lambda i, case: library.search(case.measured, size)[0])
        refined = [gicp.refine(case.measured, T, rough) for case, T in zip(tries, found, strict=True)]
        return scored(tries, refined, seconds), found

    results = {size: search(size) for size in (0.6 * voxel, voxel, 1.6 * voxel)}
    best = max(results, key=lambda size: (results[size][0].successes, -results[size][0].seconds))
    return best, results[best][1]
