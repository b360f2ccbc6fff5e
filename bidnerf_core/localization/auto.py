"""Method ``auto``: find the pose with a start or without one, by whatever was measured, and say whether to trust it.

All its decisions are made here. If the map has landmarks, they are matched first, and their pose is fused with measured
depth and rendered rays. If that pose is not accepted, the surface is searched: measured points are aligned with it where
there is enough depth, and otherwise the images are compared with its renderings. A map without a surface needs a start,
from which ``auto`` descends as ``bid`` does.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Generator

from bidnerf_core.errors import InputError
from bidnerf_core.localization.acceptance import (
    LandmarkThresholds,
    SurfaceDiagnostics,
    landmark_verdict,
    surface_diagnostics,
)
from bidnerf_core.localization.bid import BidConfig, bid
from bidnerf_core.localization.by_colour import (
    ByColourConfig,
    ColourAnswer,
    localization_of,
    refine_by_colour,
    without_the_imprecise,
)
from bidnerf_core.localization.by_landmarks import (
    answer_by_landmarks,
    fused_answer,
    is_sharp,
    localization_by_landmarks,
)
from bidnerf_core.localization.confidence import judged
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.costs.surface import PointCloud
from bidnerf_core.localization.covariance import surface_covariance
from bidnerf_core.localization.fusion import finest_cost
from bidnerf_core.localization.method_settings import (
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
    rendered_depth_scale,
)
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import take_few_steps
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search.by_images import ImageSearch
from bidnerf_core.localization.search.by_points import PointSearch
from bidnerf_core.localization.search.halving import SearchResult
from bidnerf_core.localization.search.hypotheses import Surroundings, hypotheses_for_images
from bidnerf_core.localization.search.landmarks import confirm
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.mirrored import SUSPICIOUS, mirror_evidence
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.se3 import SE3
from bidnerf_core.settings import EXPERT, Range, Settings

LEAST_POINTS = 50
"""Least number of measured depths from which the shape of the scene can be recognised."""
WORSE = 0.05
"""Largest increase of the cost on the surface by refinement; with more, field and surface contradict each other."""
MANY_LANDMARKS = 500
"""The number of landmarks from which on a scene is textured."""
WITHOUT_SEARCH = LandmarkThresholds(log10_nfa=0.0)
"""Thresholds for landmarks that match near a pose that was not found by them."""
SUPPORTED = 0.45
"""Least confidence of landmarks in a pose that the surface accepts on its own grounds."""
LOSS_POINTS = 200
"""Number of points on which the losses along the path are computed."""


@dataclass(frozen=True)
class AutoConfig(Settings):
    """Settings of method ``auto``."""

    # largest number of measured points that are aligned
    points: Annotated[int, Range(LEAST_POINTS, 10**6)] = 2000
    hypotheses: Annotated[int, Range(8, 10**5)] = 256  # number of poses with which a round of search begins
    # largest number of rounds of search, each with fresh hypotheses, until an answer is accepted
    rounds: Annotated[int, Range(1, 100)] = 3
    # steps on rendered rays that refine an answer by depth; 0: none
    refine_steps: Annotated[int, Range(0, 1000)] = 2
    refine_rays: Annotated[int, Range(64, 10**6)] = 512  # number of rays rendered for each of these steps
    landmarks: bool = True  # match image features with the map's landmarks first, where it has some
    # number of rendered rays that are fused with landmarks; 0: none
    fused_rays: Annotated[int, Range(0, 10**6)] = 1024
    by_colour: Annotated[ByColourConfig, EXPERT] = ByColourConfig()


def auto(problem: Problem, config: AutoConfig, seed: int = 0) -> Localization:
    """Find the pose by landmarks, else by depth on the surface, else by colour on it, else by descent from a start.

    Raises ``InputError`` if the map has no baked surface, landmarks give no pose at all, and there is no start.
    """
    began, answer, matcher = time.perf_counter(), None, problem.matcher if config.landmarks else None
    if matcher is not None:
        answer = answer_by_landmarks(problem, matcher, config.fused_rays, seed)
    if answer is not None and matcher is not None:
        rejection = _mirror_rejection(problem, matcher, answer.found.log10_nfa, seed)
        answer = answer if rejection is None else replace(answer, verdict=rejection)
    has_points = _measured_points(problem) >= LEAST_POINTS
    if answer is not None and _is_final(answer.verdict.outcome, has_points):
        return localization_by_landmarks(problem, answer, began)
    if answer is not None and problem.start is None:
        problem = replace(problem, start=answer.T)  # one more place to look
    if problem.surface is None:
        return _descended(problem, seed, "the map has no surface ('bidnerf bake' makes one)")
    if has_points:
        found = _by_points(problem, problem.surface, config, seed)
    else:
        found = _by_images(problem.without_depth(), problem.surface, config, seed)
        typical = 0.0 if matcher is None else matcher.landmarks.trial.translation
        found = without_the_imprecise(found, typical)
    return (
        found if matcher is None else _compared_with_landmarks(found, problem, matcher, config, seed, began)
    )


def _is_final(outcome: Outcome, has_points: bool) -> bool:
    """Whether the surface has nothing to add to what landmarks found."""
    if outcome is Outcome.UNCERTAIN:
        return not has_points
    # With wrong intrinsics, the surface is not found at the right place either.
    return outcome in (Outcome.CONVERGED, Outcome.MISCALIBRATED, Outcome.MIRRORED)


def _mirror_rejection(
    problem: Problem, matcher: LandmarkMatcher, log10_nfa: float, seed: int
) -> Verdict | None:
    """Return why a pose with this evidence is rejected if the mirror image of the query fits better, else None."""
    if log10_nfa < SUSPICIOUS:
        return None
    twin = mirror_evidence(matcher, problem.views, seed=seed)
    why = f"{twin.agreeing} landmarks agree with the mirror image"
    return Verdict(Outcome.MIRRORED, why) if twin.contradicts(log10_nfa) else None


def _compared_with_landmarks(
    found: Localization,
    problem: Problem,
    matcher: LandmarkMatcher,
    config: AutoConfig,
    seed: int,
    began: float,
) -> Localization:
    """Refine an answer of the surface by the landmarks that match there, or reject it if they should and do not."""
    near = confirm(matcher, problem.views, found.T_world_camera)
    if near.pose is not None and (verdict := landmark_verdict(near.pose, WITHOUT_SEARCH)).accepted:
        answer = fused_answer(problem, near.pose, verdict, config.fused_rays, seed, searched=False)
        refined = localization_by_landmarks(problem, answer, began)
        twin = _mirror_rejection(problem, matcher, near.pose.log10_nfa, seed)
        supported = (
            twin is None
            and found.converged
            and answer.confidence is not None
            and answer.confidence >= SUPPORTED
        )
        outcome = Outcome.CONVERGED if supported else refined.outcome
        if twin is not None:
            return replace(refined, outcome=twin.outcome, reason=f"{twin.reason}; {refined.reason}")
        return replace(refined, outcome=outcome, reason=f"found on the surface; {refined.reason}")
    if found.converged and near.contradicts:
        why = f"{near.matches} landmarks match, {near.chance:.0f} by chance, of {near.visible} that should be visible"
        return replace(found, outcome=Outcome.TOO_FEW_MATCHES, reason=f"{why}; {found.reason}")
    if found.converged and (twin := _mirror_rejection(problem, matcher, 0.0, seed)) is not None:
        return replace(found, outcome=twin.outcome, reason=f"{twin.reason}; {found.reason}")
    return replace(found, seconds=time.perf_counter() - began)


def _measured_points(problem: Problem) -> int:
    images = [view.frame.depth for view in problem.views if view.frame.depth is not None]
    pixels = sum(int(((depth > 0) & depth.isfinite()).sum()) for depth in images)
    return pixels + (0 if problem.depth_rays is None else len(problem.depth_rays))


def _by_points(problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int) -> Localization:
    """Align measured points with the surface, then refine on rendered rays."""
    began, generator = time.perf_counter(), Generator().manual_seed(seed)
    search = PointSearch(
        surface, PointCloud.measured(problem.views, problem.depth_rays, config.points, generator)
    )
    with torch.no_grad():
        found = _searched(problem, search, config, generator)
    inliers = 1.0
    if config.refine_steps:
        found, inliers = _refined(problem, search, found, config, generator)
    with torch.no_grad():
        diagnostics = replace(_diagnostics(search, found), rendered_inliers=inliers)
        judgement = judged(diagnostics.verdict(), diagnostics)
        path = found.path if problem.start is None else SE3.cat([problem.start[None], found.path[1:]])
        losses = search.judge(LOSS_POINTS).cost(path)
        covariance = surface_covariance(search.judge(), found.T[0], len(problem.views))
    return Localization(
        T_world_camera=found.T[0].normalized(),
        outcome=judgement.verdict.outcome,
        reason=judgement.verdict.reason,
        steps=len(losses) - 1,
        seconds=time.perf_counter() - began,
        loss=float(found.scores[0]),
        method="auto",
        poses=path,
        losses=losses[:-1],
        covariance=covariance,
        confidence=judgement.confidence,
        diagnostics=diagnostics,
    )


def _searched(
    problem: Problem, search: PointSearch, config: AutoConfig, generator: Generator
) -> SearchResult:
    """Search in rounds until an answer is acceptable, and return the best one."""
    answers: list[SearchResult] = []
    while True:
        answers.append(search(problem.start, config.hypotheses, generator))
        best = min(answers, key=lambda found: float(found.scores[0]))
        if len(answers) == config.rounds or _diagnostics(search, best).rejection() is None:
            return best


def _diagnostics(search: PointSearch, found: SearchResult) -> SurfaceDiagnostics:
    return surface_diagnostics(search.judge(), found.T[0], found.margin)


def _refined(
    problem: Problem, search: PointSearch, found: SearchResult, config: AutoConfig, generator: Generator
) -> tuple[SearchResult, float]:
    """Return a refined pose, and the share of rendered rays that agree with the measurements there.

    The surface is as coarse as its cells, and the field as its training: both count as far as they agree with what was
    measured.
    """
    scale = rendered_depth_scale(problem.bounds)
    stage = RefinementStage(
        config.refine_steps, config.refine_rays, depth_scale=scale, surface_sigma=scale / 12
    )
    settings = RenderedCostSettings(ColourSettings(), DepthSettings(), RefinementSettings())
    finest = finest_cost(search.surface, search.cloud)
    steps = take_few_steps(problem, found.T[0], stage, settings, generator, finest)
    with torch.no_grad():
        scores = search.score(steps.poses)
    if not float(scores[-1]) <= float(scores[0]) + WORSE:
        return found, 0.0
    path = SE3.cat([found.path, steps.poses[1:]])
    return replace(found, T=steps.poses[-1:], scores=scores[-1:], path=path), steps.inliers


def _by_images(problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int) -> Localization:
    """Compare the images with renderings of the surface, in rounds until an answer is accepted, and refine each answer."""
    began, generator = time.perf_counter(), Generator().manual_seed(seed)
    search, answers = ImageSearch.on_surface(problem, surface), list[ColourAnswer]()
    # Images with a plain background were rendered and are as bright as the map; photos may have another exposure.
    exposure = config.by_colour.refinement.exposure or not search.has_background
    refinement = replace(config.by_colour.refinement, exposure=exposure)
    by_colour = replace(config.by_colour, refinement=refinement)
    known = Surroundings(SE3.from_matrix(surface.keyframes), surface.extent, torch.zeros(3), search.middle)
    while True:
        with torch.no_grad():
            found = search(hypotheses_for_images(known, problem.start, config.hypotheses, generator))
        if config.landmarks and _is_hopeless(problem):
            return _unrecognised(found, began)
        answers.append(refine_by_colour(problem, found, by_colour, generator))
        best = min(answers, key=lambda answer: answer.refined.loss)
        if best.verdict.accepted or len(answers) == config.rounds:
            return localization_of(problem, best, by_colour, began, "auto")


def _is_hopeless(problem: Problem) -> bool:
    """Whether an image without recognised landmarks cannot be found: the scene is textured, and its field blurred."""
    textured = problem.matcher is not None and len(problem.matcher.landmarks) >= MANY_LANDMARKS
    return textured and not is_sharp(problem)


def _unrecognised(found: SearchResult, began: float) -> Localization:
    """Return the best pose of a search by images as rejected; refining it on rendered rays would take many seconds."""
    return Localization(
        T_world_camera=found.T[0].normalized(),
        outcome=Outcome.TOO_FEW_MATCHES,
        reason="no landmarks were recognised, and the field is too blurred to compare images with its renderings",
        steps=len(found.losses),
        seconds=time.perf_counter() - began,
        loss=float(found.scores[0]),
        method="auto",
        poses=found.path,
        losses=found.losses,
    )


def _descended(problem: Problem, seed: int, why: str) -> Localization:
    if problem.start is None:
        raise InputError(f"{why}: method 'auto' needs a start then; give one")
    found = bid(problem, BidConfig(), seed)
    return replace(found, reason=f"{why}; {found.reason}")
