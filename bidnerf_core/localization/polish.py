"""The last steps on colour: on rendered rays in full detail, and what fresh rays say of where they end."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Generator

from bidnerf_core.localization.photometric import Refined, refine
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.settings import Judged
from bidnerf_core.localization.solvers.pivots import PivotName
from bidnerf_core.localization.stages import Refinement, Stage
from bidnerf_core.pixels import DrawerName
from bidnerf_core.robust import RobustName
from bidnerf_core.se3 import SE3


@dataclass(frozen=True)
class PolishConfig(Judged):
    """Settings of the steps on rendered rays."""

    coarse_steps: int = 4  # of each pose that the search gave, at the coarsest level
    coarse_rays: int = 256  # for each of them
    fine_steps: int = 8  # of the best one, in full detail
    fine_rays: int = 1024
    pixels: DrawerName = "uniform"  # where pixels are drawn: anywhere, at corners, around corners
    pivot: PivotName = "scene"  # what an update turns about: the middle of what is seen, camera, world
    colour_loss: RobustName = "huber"  # robust loss of colour differences
    colour_scale: float = 0.1  # of it, in differences of colour: about where an outlier begins
    play: float = 0.006  # metres that surfaces may be off at coarse steps, half of it at fine ones
    exposure: bool = False  # estimate a gain and a bias of each colour along
    least_weight: float = 0.01  # samples of less rendering weight have no part in derivatives
    stop_step: float = 1e-4  # a stage ends once a step is shorter than this (metres, radians)
    converged_inliers: float = 0.93  # share of fresh rays that must see what was measured ...
    converged_step: float = 0.02  # ... and longest step that they may ask for (metres, radians)

    def __post_init__(self) -> None:
        for name in ("coarse_rays", "fine_rays"):
            self._require(name, 7 <= getattr(self, name) <= 10**7, "7 to 10 million")
        for name in ("coarse_steps", "fine_steps"):
            self._require(name, 1 <= getattr(self, name) <= 10**5, "1 to 100 thousand")
        self._require("colour_scale", 0 < self.colour_scale <= 1e6, "a positive number, at most 1e+06")
        self._require("least_weight", 0 <= self.least_weight < 1, "a number from 0 to less than 1")
        self._require_one_of(pixels=DrawerName, pivot=PivotName, colour_loss=RobustName)
        for name in ("play", "stop_step", "converged_inliers", "converged_step"):
            self._require_not_negative(name)


def polished(problem: Problem, start: SE3, config: PolishConfig, generator: Generator) -> Refined:
    """The best of the poses ``start`` (h), after steps on colour alone."""
    settings = Refinement(
        0.0, config.colour_loss, "huber", config.pixels, config.pivot, config.exposure, 0, config.least_weight,
        stop_step=config.stop_step,
    )  # fmt: skip
    c, count = config, len(start.translation)
    stages = (
        Stage(c.coarse_steps, c.coarse_rays, count, 0, 2, c.colour_scale, play=c.play),
        Stage(c.fine_steps, c.fine_rays, 1, None, 1, c.colour_scale, play=c.play / 2),
    )
    return refine(without_depth(problem), start, stages, settings, generator)


def without_depth(problem: Problem) -> Problem:
    views = tuple(replace(view, frame=replace(view.frame, depth=None)) for view in problem.views)
    return replace(problem, views=views, depth_rays=None)
