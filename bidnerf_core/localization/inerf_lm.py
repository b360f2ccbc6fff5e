"""Method ``inerf-lm``: the colours of one or several images, by second-order steps from coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass, replace

from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.second_order import Depth, SecondOrderConfig, second_order
from bidnerf_core.localization.stages import Refinement


@dataclass(frozen=True)
class InerfLmConfig(SecondOrderConfig):
    """Settings of method ``inerf-lm``."""

    poses: int = 256  # looked at first: the start, and others about it; 1: the start alone
    spread_translation: float = 0.12  # their standard deviation along each axis of the camera, metres
    spread_rotation: float = 0.25  # and about each, radians
    coarse_poses: int = 8  # the best of these, which take steps at the coarsest level
    coarse_steps: int = 6
    middle_steps: int = 6


def inerf_lm(problem: Problem, config: InerfLmConfig, seed: int = 0) -> Localization:
    """From ``problem.start``; poses about it and pixels are drawn from ``seed``. Measured depth is not looked at."""
    settings = Refinement(
        0.0, config.colour_loss, "huber", config.pixels, config.pivot, config.exposure, 0, config.least_weight,
        stop_step=config.stop_step,
    )  # fmt: skip
    return second_order(without_depth(problem), config, Depth(), settings, seed, "inerf-lm")


def without_depth(problem: Problem) -> Problem:
    views = tuple(replace(view, frame=replace(view.frame, depth=None)) for view in problem.views)
    return replace(problem, views=views, depth_rays=None)
