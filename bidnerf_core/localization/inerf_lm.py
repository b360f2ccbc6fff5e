"""Method ``inerf-lm``: the colours of one or several images, by second-order steps from coarse to fine."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated

from torch import Generator

from bidnerf_core.localization.by_colour import (
    ByColourConfig,
    ColourRefinementSettings,
    localization_of,
    refine_by_colour,
)
from bidnerf_core.localization.method_settings import (
    ColourSettings,
    RefinementSettings,
    RenderedThresholds,
    SpreadSettings,
)
from bidnerf_core.localization.methods import Method
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.search.by_images import ImageSearch, ImageStage
from bidnerf_core.localization.search.hypotheses import neighbours
from bidnerf_core.settings import EXPERT, Range, Settings

StepCount = Annotated[int, Range(1, 10**5), EXPERT]


@dataclass(frozen=True)
class ImageSearchSettings(Settings):
    """Settings of the search with small renderings, which become larger as poses become fewer."""

    search_poses: StepCount = 24  # number of best poses that take steps on small renderings
    search_steps: StepCount = 8  # steps of each of the search poses
    middle_poses: StepCount = 6  # number of best search poses that take steps on larger renderings
    middle_steps: StepCount = 6  # steps of each of the middle poses
    last_steps: StepCount = 4  # steps of the best two poses, on the largest renderings
    # longer side of the first renderings, pixels; the last ones are 3 times as large
    width: Annotated[int, Range(4, 1000)] = 16

    def stages(self) -> tuple[ImageStage, ...]:
        return (
            ImageStage(self.width, 0, self.search_poses),
            ImageStage(self.width, self.search_steps, self.middle_poses),
            ImageStage(self.width * 3 // 2, self.middle_steps, 2),
            ImageStage(self.width * 3, self.last_steps, 2),
        )


@dataclass(frozen=True)
class InerfLmConfig(Settings):
    """Settings of method ``inerf-lm``."""

    spread: SpreadSettings = SpreadSettings(256, 0.12, 0.25)
    search: ImageSearchSettings = ImageSearchSettings()
    steps: ColourRefinementSettings = ColourRefinementSettings()
    colour: ColourSettings = ColourSettings()
    refinement: RefinementSettings = RefinementSettings(surface_sigma=0.006)
    thresholds: RenderedThresholds = RenderedThresholds()


def inerf_lm(problem: Problem, config: InerfLmConfig, seed: int = 0) -> Localization:
    """Refine poses about ``problem.start``; they and the pixels are drawn from ``seed``.

    It needs the field alone, and uses neither measured depth nor a baked surface.
    """
    began, generator, spread = time.perf_counter(), Generator().manual_seed(seed), config.spread
    start = problem.start_for("inerf-lm")
    problem = problem.without_depth()
    many = neighbours(start, spread.poses, spread.spread_translation, spread.spread_rotation, seed)
    found = ImageSearch.in_field(problem, start)(many, config.search.stages())
    refinement = ByColourConfig(config.steps, config.colour, config.refinement, config.thresholds)
    answer = refine_by_colour(replace(problem, start=start), found, refinement, generator)
    return localization_of(problem, answer, refinement, began, "inerf-lm")


INERF_LM = Method(
    inerf_lm,
    InerfLmConfig,
    needs_start=True,
    uses_depth=False,
    summary="second-order steps on colour alone, from coarse to fine",
)
