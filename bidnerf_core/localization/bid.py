"""Method ``bid``: colour and depth of one or several images, at the coarse level (BID-NeRF, Alg. 1)."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.solvers.adam import DescentConfig, descend
from bidnerf_core.localization.solvers.pivots import PivotName
from bidnerf_core.residuals import Objective
from bidnerf_core.robust import Robust, RobustName


@dataclass(frozen=True)
class BidConfig(DescentConfig):
    """Settings of method ``bid``."""

    learning_rate: float = (
        0.04  # metres that a step moves the camera, at first; radians about a pivot within 1 m
    )
    decay: float = 0.4  # factor on the learning rate ...
    decay_steps: int = 80  # ... after so many steps
    level: int | None = 0  # of the field: 0 is the coarsest; none is the field itself, in full detail
    pivot: PivotName = (
        "scene"  # what an update turns about: the middle of what is seen; the paper's is the camera
    )
    depth_weight: float = 1.0  # lambda_d
    depth_loss: RobustName = "huber"  # robust loss of depth differences
    depth_rays: int = 512  # besides, of a sensor with rays of its own, where there is one
    depth_scale: float = 0.1  # of it, in metres: about where an outlier begins
    free_space_weight: float = 0.0  # of matter that is rendered farther than that before what was measured

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("depth_scale", 0 < self.depth_scale <= 1e6, "a positive number, at most 1e+06")
        self._require("depth_rays", 0 <= self.depth_rays <= 10**7, "0 to 10 million")
        self._require_one_of(depth_loss=RobustName)
        for name in ("depth_weight", "free_space_weight"):
            self._require_not_negative(name)

    @property
    def objective(self) -> Objective:
        return Objective(
            Robust(self.colour_loss, self.colour_scale),
            Robust(self.depth_loss, self.depth_scale),
            self.depth_weight,
            self.free_space_weight,
        )


def bid(problem: Problem, config: BidConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start``; pixels are drawn from ``seed``."""
    return descend(problem, config, config.objective, config.depth_rays, seed, "bid")
