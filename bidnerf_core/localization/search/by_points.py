"""Search by measured depth: align the query's points with the baked surface."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.devices import moved
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.costs.surface import PointCloud, PointScales, SurfaceCost
from bidnerf_core.localization.covariance import FINEST
from bidnerf_core.localization.search.halving import Distinct, SearchResult, SearchStage, search
from bidnerf_core.localization.search.starts import Surroundings, hypotheses_for_points
from bidnerf_core.mapping import SurfaceMap

JUDGED = 0.02
"""Distance scale for comparing poses, as a fraction of the scene's extent."""
COMPARED_POINTS = 200
"""Minimum number of points on which poses are compared within a search."""
APART, TURNED = 0.05, math.radians(10)
"""Distance (fraction of the extent, radians) beyond which two poses are different answers."""


@dataclass(frozen=True)
class PointStage:
    """A stage of the search: steps from all remaining poses, the best ``keep`` of which pass to the next stage."""

    points: int
    steps: int
    keep: int
    distance: float  # distance scale as a fraction of the scene's extent; 0: the finest
    colour_weight: float


# Colour has no weight at first: its derivatives are valid only within a surfel, and would only slow down distant poses.
POINT_STAGES = (
    PointStage(48, 0, 96, 0.3, 0.0),
    PointStage(48, 8, 24, 0.3, 0.0),
    PointStage(100, 10, 6, 0.2, 0.0),
    PointStage(400, 6, 2, 0.05, 0.1),
    PointStage(2000, 4, 1, 0.0, 1.0),
)


@dataclass(frozen=True, eq=False)
class PointSearch:
    """Search by aligning measured points with a surface, starting from hypotheses all over the scene.

    Steps are taken on the surface's device. Poses are given and returned on the CPU.
    """

    surface: SurfaceMap
    cloud: PointCloud

    def __post_init__(self) -> None:
        object.__setattr__(self, "cloud", self.cloud.to(self.surface.device))

    def __call__(self, start: SE3 | None, count: int, generator: Generator) -> SearchResult:
        """Search once, from ``count`` new hypotheses."""
        return self.from_poses(hypotheses_for_points(self.surroundings, start, count, generator))

    def from_poses(self, T: SE3, stages: tuple[PointStage, ...] = POINT_STAGES) -> SearchResult:
        """Search from the hypotheses T (h)."""
        apart = APART * self.surface.extent
        distinct = Distinct(self.cloud.middle, apart, TURNED)
        return search(T, self._stages(stages), distinct, keep_runner_up=False, device=self.surface.device)

    @property
    def surroundings(self) -> Surroundings:
        """The input for drawing hypotheses; on the CPU, so that a seed gives the same ones on any device."""
        surface = self.surface
        keyframes, middle = SE3.from_matrix(surface.keyframes), surface.surfels.positions.median(0).values
        return moved(Surroundings(keyframes, surface.extent, middle, self.cloud.middle), "cpu")

    def judge(self, points: int | None = None) -> SurfaceCost:
        """Return the cost of the first ``points`` (all by default), at the fixed scale for comparing poses."""
        cloud = self.cloud if points is None else self.cloud.first(points)
        return SurfaceCost(self.surface, cloud, PointScales(JUDGED * self.surface.extent))

    def score(self, T: SE3) -> Float[Tensor, "h"]:
        """Return the score by which poses are compared: 0 (best) to 2."""
        return self.judge().cost(T)

    def _stages(self, stages: tuple[PointStage, ...]) -> Iterator[SearchStage]:
        for stage in stages:
            some = self.cloud.first(stage.points)
            distance = stage.distance * self.surface.extent or FINEST * self.surface.cell
            cost = SurfaceCost(self.surface, some, PointScales(distance, colour_weight=stage.colour_weight))
            score = self.judge(max(stage.points, COMPARED_POINTS)).cost if stage.steps else None
            yield SearchStage(cost, some.pivot, stage.steps, stage.keep, damping=1e-4, score=score)
