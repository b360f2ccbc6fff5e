"""Coarse-to-fine second-order methods: ``bid-lm`` on colour and depth, and ``inerf-lm`` on colour alone."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated

from torch import Generator

from bidnerf_core.localization.acceptance import rendered_verdict
from bidnerf_core.localization.by_colour import localization_of, refine_by_colour
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.methods import Method
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import refine
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.search.by_images import ImageSearch, ImageStage
from bidnerf_core.localization.search.starts import neighbours
from bidnerf_core.localization.settings import (
    ByColourConfig,
    ColourRefinementSettings,
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
    RenderedThresholds,
    SpreadSettings,
)
from bidnerf_core.settings import EXPERT, NotNegative, Range, Settings

Steps = Annotated[int, Range(1, 10**5)]
ExpertCount = Annotated[int, Range(1, 10**5), EXPERT]
RayCount = Annotated[int, Range(7, 10**7)]
ExpertRays = Annotated[int, Range(7, 10**7), EXPERT]


@dataclass(frozen=True)
class BidLmStages(Settings):
    """Settings of the stages, from many poses on few rays at the coarsest level to one pose on many rays."""

    search_rays: ExpertRays = 128  # number of rays by which each of the poses around the start is ranked
    coarse_poses: ExpertCount = 6  # number of best poses that take steps at the coarsest level
    coarse_steps: ExpertCount = 4  # steps of each of the coarse poses
    coarse_rays: ExpertRays = 128  # number of rays for each of the coarse poses
    middle_poses: ExpertCount = 2  # number of best coarse poses that take further steps
    middle_steps: ExpertCount = 4  # steps of each of the middle poses
    middle_rays: ExpertRays = 256  # number of rays for each of the middle poses
    fine_steps: Steps = 6  # steps of the best pose, in full detail
    fine_rays: RayCount = 1024  # number of rays rendered for each of the fine steps
    # width, in pixels, of the squares over which colours are averaged in coarse steps
    blur: Annotated[int, Range(1, 10**4), EXPERT] = 8
    # number of times that poses are first centred on the measured points
    centring: Annotated[int, Range(0, 100), EXPERT] = 2
    # half width of the interval around the depth that fine steps sample, metres; 0: the whole ray
    depth_window: Annotated[NotNegative, EXPERT] = 0.0


@dataclass(frozen=True)
class BidLmConfig(Settings):
    """Settings of method ``bid-lm``."""

    spread: SpreadSettings = SpreadSettings()
    stages: BidLmStages = BidLmStages()
    colour: ColourSettings = ColourSettings()
    depth: DepthSettings = DepthSettings(depth_weight=3.0, depth_rays=256)
    refinement: RefinementSettings = RefinementSettings()
    thresholds: RenderedThresholds = RenderedThresholds()


def bid_lm(problem: Problem, config: BidLmConfig, seed: int = 0) -> Localization:
    """Refine poses around ``problem.start``; poses and pixels are drawn from ``seed``."""
    began, spread = time.perf_counter(), config.spread
    start = problem.start_for("bid-lm")
    poses = neighbours(start, spread.poses, spread.spread_translation, spread.spread_rotation, seed)
    settings = RenderedCostSettings(config.colour, config.depth, config.refinement)
    found = refine(problem, poses, stages(config), settings, Generator().manual_seed(seed))
    verdict = rendered_verdict(found, config.thresholds)
    return Localization(
        T_world_camera=found.T,
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=len(found.losses),
        seconds=time.perf_counter() - began,
        loss=found.loss,
        method="bid-lm",
        poses=found.poses,
        losses=found.losses,
        covariance=found.covariance if bool(found.covariance.isfinite().all()) else None,
        confidence=verdict.confidence,
        diagnostics=found.support,
    )


def stages(config: BidLmConfig) -> tuple[RefinementStage, ...]:
    """Return the stages given by the settings."""
    s, sigma = config.stages, config.refinement.surface_sigma
    scales = (config.colour.colour_scale, config.depth.depth_scale)
    wide = (3 * scales[0], 3 * scales[1])
    return (
        RefinementStage(0, s.search_rays, config.spread.poses, 0, s.blur, *wide, centring=s.centring),
        RefinementStage(s.coarse_steps, s.coarse_rays, s.coarse_poses, 0, s.blur, *scales, sigma),
        RefinementStage(s.middle_steps, s.middle_rays, s.middle_poses, 0, s.blur, *scales, sigma),
        RefinementStage(s.fine_steps, s.fine_rays, 1, None, 1, *scales, sigma / 3, s.depth_window),
    )


BID_LM = Method(
    bid_lm,
    BidLmConfig,
    needs_start=True,
    summary="second-order steps on colour and depth, from coarse to fine",
)


@dataclass(frozen=True)
class ImageSearchSettings(Settings):
    """Settings of the search with small renderings, which grow as the number of poses decreases."""

    search_poses: ExpertCount = 24  # number of best poses that take steps on small renderings
    search_steps: ExpertCount = 8  # steps of each of the search poses
    middle_poses: ExpertCount = 6  # number of best search poses that take steps on larger renderings
    middle_steps: ExpertCount = 6  # steps of each of the middle poses
    last_steps: ExpertCount = 4  # steps of the best two poses, on the largest renderings
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
    """Refine poses around ``problem.start``; poses and pixels are drawn from ``seed``.

    It needs only the field, and uses neither measured depth nor a baked surface.
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
