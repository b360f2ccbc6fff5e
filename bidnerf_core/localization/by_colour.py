"""Poses by colour alone: search with small images, refine by second-order steps on rendered rays, then accept or reject."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.geometry import SE3, USUAL
from bidnerf_core.localization.acceptance import rendered_verdict
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.covariance import position_deviation
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import RefinementResult, refine
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import ByColourConfig, RefinementStage

TYPICAL_ERRORS = 4.5
"""Maximum standard deviation of an accepted position, in median errors of the map's own images."""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The remaining poses of a search, and the margin of the best over any different one; on the CPU."""

    T: SE3  # (h), best first
    scores: Float[Tensor, "h"]
    margin: float  # score of the best different pose minus that of the best; infinite if there was none
    path: SE3  # (s + 1): from the winning hypothesis to the best pose
    losses: Float[Tensor, "s"]  # of the path before each step; costs of different stages are not comparable


@dataclass(frozen=True, eq=False)
class ColourAnswer:
    """The result of a search, its refinement, and the verdict on it."""

    search: SearchResult
    refined: RefinementResult
    verdict: Verdict


def refine_by_colour(
    problem: Problem,
    search: SearchResult,
    config: ByColourConfig,
    generator: Generator,
    stages: Sequence[RefinementStage] = (),
) -> ColourAnswer:
    """Refine the poses found by a search on colour alone, and accept or reject the result; ``stages`` replace the usual ones."""
    stages = stages or usual_stages(config, len(search.T.translation))
    settings = RenderedCostSettings(config.colour, None, config.refinement)
    refined = refine(problem, search.T, stages, settings, generator)
    return ColourAnswer(search, refined, rendered_verdict(refined, config.thresholds))


def usual_stages(config: ByColourConfig, count: int) -> tuple[RefinementStage, ...]:
    """Return a stage at the coarsest level from each of ``count`` poses, and one in full detail from the best."""
    s, scale, sigma = config.steps, config.colour.colour_scale, config.refinement.surface_sigma
    return (
        RefinementStage(s.coarse_steps, s.coarse_rays, count, 0, 2, scale, surface_sigma=sigma),
        RefinementStage(s.fine_steps, s.fine_rays, 1, None, 1, scale, surface_sigma=sigma / 2),
    )


def localization_of(
    problem: Problem, answer: ColourAnswer, config: ByColourConfig, began: float, method: str
) -> Localization:
    """Convert an answer to a localization.

    Its path joins those of the search and the refinement. If there is a start, the path begins there, since the choice of a
    hypothesis is part of the first step.
    """
    refined, search = answer.refined, answer.search
    path = [T[i] for T in (search.path[:-1], refined.poses) for i in range(len(T.translation))]
    path[0] = problem.start or path[0]
    # The errors of neighbouring rays are correlated, so the rays of a view count as only a few independent ones.
    covariance = refined.covariance * max(
        1.0, config.steps.fine_rays / (USUAL.rays_alone * len(problem.views))
    )
    return Localization(
        T_world_camera=refined.T.normalized(),
        outcome=answer.verdict.outcome,
        reason=answer.verdict.reason,
        steps=len(path) - 1,
        seconds=time.perf_counter() - began,
        loss=refined.loss,
        method=method,
        poses=SE3.stack(path),
        losses=torch.cat([search.losses, refined.losses]),
        covariance=covariance if bool(covariance.isfinite().all()) else None,
        confidence=answer.verdict.confidence,
        diagnostics=refined.support,
    )


def without_the_imprecise(found: Localization, typical: float) -> Localization:
    """Reject an accepted pose whose position is far less certain than usual, since blurred images fit many poses.

    ``typical`` is the median error of the map's own images (metres); 0 if unknown.
    """
    if not found.converged or found.covariance is None or typical <= 0:
        return found
    deviation = position_deviation(found.covariance)
    if deviation <= TYPICAL_ERRORS * typical:
        return found
    why = f"the position is uncertain by {deviation:.3g}, against {typical:.3g} for the map's own images"
    return found.rejected(Verdict(Outcome.IMPRECISE, why))
