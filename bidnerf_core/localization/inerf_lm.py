"""Method ``inerf-lm``: the colours of one or several images, by second-order steps from coarse to fine."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch
from torch import Generator

from bidnerf_core.localization.neighbours import neighbours
from bidnerf_core.localization.polish import PolishConfig, polished, without_depth
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.rgb_only import answered, doubted
from bidnerf_core.localization.rgb_search import Sight, Stage, search
from bidnerf_core.localization.sketches import ByField
from bidnerf_core.localization.thumbnails import thumbnail
from bidnerf_core.se3 import SE3


@dataclass(frozen=True)
class InerfLmConfig(PolishConfig):
    """Settings of method ``inerf-lm``."""

    poses: int = 256  # looked at first: the start, and others about it; 1: the start alone
    spread_translation: float = 0.12  # their standard deviation along each axis of the camera, metres
    spread_rotation: float = 0.25  # and about each, radians
    search_poses: int = 24  # the best of these, which take steps on small renderings
    search_steps: int = 8
    middle_poses: int = 6  # the best of these, which take more on larger ones
    middle_steps: int = 6
    last_steps: int = 4  # of the best two, on the largest renderings
    width: int = 16  # pixels along the longer side of the first renderings; later ones have half and twice as many more

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("poses", "search_poses", "middle_poses"):
            self._require(name, 1 <= getattr(self, name) <= 10**5, "1 to 100 thousand")
        for name in ("search_steps", "middle_steps", "last_steps"):
            self._require(name, 1 <= getattr(self, name) <= 10**5, "1 to 100 thousand")
        self._require("width", 4 <= self.width <= 1000, "4 to 1000 pixels")
        for name in ("spread_translation", "spread_rotation"):
            self._require_not_negative(name)


def inerf_lm(problem: Problem, config: InerfLmConfig, seed: int = 0) -> Localization:
    """From ``problem.start``; poses about it and pixels are drawn from ``seed``. It needs the field alone: measured depth is
    not looked at, nor is a baked surface.
    """
    began, generator = time.perf_counter(), Generator().manual_seed(seed)
    start = problem.start_for("inerf-lm")
    problem = without_depth(problem)
    many = neighbours(start, config.poses, config.spread_translation, config.spread_rotation, seed)
    stages = (
        Stage(config.width, 0, config.search_poses),
        Stage(config.width, config.search_steps, config.middle_poses),
        Stage(config.width * 3 // 2, config.middle_steps, 2),
        Stage(config.width * 3, config.last_steps, 2),
    )
    found = search(rendered_sight(problem, start), many, stages)
    refined = polished(replace(problem, start=start), found.T, config, generator)
    return replace(
        answered(problem, refined, found, config, began, doubted(refined, found, config)), method="inerf-lm"
    )


def rendered_sight(problem: Problem, start: SE3) -> Sight:
    """At the coarsest level. How far things are is what renderings from the start tell."""
    sketcher = ByField(problem.level(0), problem.bounds, problem.device)
    small = thumbnail(problem.views[-1], 16)
    T = start.to(small.flat)
    directions = T.rotate(torch.nn.functional.normalize(small.flat, dim=-1))
    away = float(sketcher(T.translation.expand_as(directions), directions).along.median())
    extent = float(torch.linalg.vector_norm(torch.tensor(problem.bounds.size)))
    return Sight(problem.views, sketcher, torch.tensor([0.0, 0.0, away]), extent)
