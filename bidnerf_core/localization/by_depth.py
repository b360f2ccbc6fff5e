"""Localization by measured depth: align points with the baked surface, then refine on rendered rays."""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from torch import Generator

from bidnerf_core.geometry import SE3, USUAL, Robust
from bidnerf_core.localization.acceptance import SurfaceDiagnostics, surface_diagnostics
from bidnerf_core.localization.beyond_chance import support
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.costs.surface import PointCloud, SurfaceCost
from bidnerf_core.localization.covariance import finest_cost, surface_covariance
from bidnerf_core.localization.exposure import clipped, robust_exposure
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import take_few_steps
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.search.by_points import COMPARED_POINTS, POINT_STAGES, PointSearch
from bidnerf_core.localization.search.halving import SearchResult
from bidnerf_core.localization.settings import (
    AutoConfig,
    ColourSettings,
    DepthSettings,
    RefinementSettings,
    RefinementStage,
    rendered_depth_scale,
)
from bidnerf_core.mapping import SurfaceMap

WORSE = 0.05
"""Maximum increase of the cost on the surface by refinement; beyond it, field and surface contradict each other."""


def localized_by_depth(problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int) -> Localization:
    """Align measured points with the surface, then refine on rendered rays."""
    began, generator = time.perf_counter(), Generator().manual_seed(seed)
    search = PointSearch(
        surface, PointCloud.measured(problem.views, problem.depth_rays, config.points, generator)
    )
    with torch.no_grad():
        found, search = _searched(problem, search, config, generator)
    inliers = 1.0
    if config.refine_steps:
        found, inliers = _refined(problem, search, found, config, generator)
    with torch.no_grad():
        finest = finest_cost(search.surface, search.cloud)
        apart = support(finest.point_costs, found.T[0], search.cloud.middle.double().cpu())
        diagnostics = replace(_diagnostics(search, found), rendered_inliers=inliers, support=apart)
        verdict = diagnostics.verdict()
        path = found.path if problem.start is None else SE3.cat([problem.start[None], found.path[1:]])
        losses = search.judge(COMPARED_POINTS).cost(path)
        covariance = surface_covariance(
            search.judge(), found.T[0], len(problem.views), problem.sensor, USUAL.points
        )
    return Localization(
        T_world_camera=found.T[0].normalized(),
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=len(losses) - 1,
        seconds=time.perf_counter() - began,
        loss=float(found.scores[0]),
        method="auto",
        poses=path,
        losses=losses[:-1],
        covariance=covariance,
        confidence=verdict.confidence,
        diagnostics=diagnostics,
    )


def _searched(
    problem: Problem, search: PointSearch, config: AutoConfig, generator: Generator
) -> tuple[SearchResult, PointSearch]:
    """Search in rounds until a pose is acceptable; return the best one and the search with the image's exposure there."""
    answers: list[SearchResult] = []
    while True:
        answers.append(search(problem.start, config.hypotheses, generator))
        best, exposed = _with_exposure(search, min(answers, key=lambda found: float(found.scores[0])))
        if len(answers) == config.rounds or _diagnostics(exposed, best).rejection() is None:
            return best, exposed


def _with_exposure(search: PointSearch, found: SearchResult) -> tuple[SearchResult, PointSearch]:
    """Align a pose again with the points' colours converted to the map's exposure; return it and the new search."""
    cloud = cloud_with_exposure_of_map(search.judge(), found.T[0])
    if cloud is search.cloud:
        return found, search
    exposed = replace(search, cloud=cloud)
    again = exposed.from_poses(found.T, POINT_STAGES[-1:])
    path = SE3.cat([found.path, again.path[1:]])
    return replace(found, T=again.T, scores=again.scores, path=path), exposed


def _diagnostics(search: PointSearch, found: SearchResult) -> SurfaceDiagnostics:
    return surface_diagnostics(search.judge(), found.T[0], found.margin)


def _refined(
    problem: Problem, search: PointSearch, found: SearchResult, config: AutoConfig, generator: Generator
) -> tuple[SearchResult, float]:
    """Return a refined pose and the fraction of rendered rays that agree with the measurements there.

    The surface is limited by its cells, and the field by its training: each is weighted by how well it agrees with the
    measurements.
    """
    scale = rendered_depth_scale(problem.bounds)
    stage = RefinementStage(
        config.refine_steps, config.refine_rays, depth_scale=scale, surface_sigma=scale / 12
    )
    settings = RenderedCostSettings(ColourSettings(), DepthSettings(), RefinementSettings(exposure=True))
    finest = finest_cost(search.surface, search.cloud)
    steps = take_few_steps(problem, found.T[0], stage, settings, generator, finest)
    with torch.no_grad():
        scores = search.score(steps.poses)
    if not float(scores[-1]) <= float(scores[0]) + WORSE:
        return found, 0.0
    path = SE3.cat([found.path, steps.poses[1:]])
    return replace(found, T=steps.poses[-1:], scores=scores[-1:], path=path), steps.inliers


STRONGEST, MOST_BIAS = 4.0, 0.25
"""Maximum gain (its inverse is the minimum) and maximum bias of an exposure: two stops, and a quarter of the range."""
LEAST_COLOURED = 0.2
"""Minimum fraction of the points whose colours the camera did not clip."""
CLEARLY_MORE = 0.05
"""Minimum increase of the colour inliers by an exposure, as a fraction of all points, for it to be applied.

Blur also lowers contrast, but restoring that contrast only enlarges the differences.
"""


def cloud_with_exposure_of_map(cost: SurfaceCost, T: SE3) -> PointCloud:
    """Return the points of ``cost`` with their colours converted to the map's exposure.

    The exposure, a gain and a bias per channel, is fitted to the points that lie on the surface at the pose T. Points count as
    uncoloured if the camera clipped a colour and the exposure maps the surface's colour beyond black or white. The points are
    returned unchanged if the exposure is too far from the map's, too few points keep their colour, or hardly any more become
    colour inliers.
    """
    found, cloud = cost.correspondences(T[None]), cost.cloud
    near, alike = cost.inliers(found)
    difference, _ = cost.colour_differences(found)
    measured = cloud.rgb.double().mT
    weights = (near[0] * cloud.coloured).expand_as(measured).double()
    surface = difference.double().mT + measured
    fitted = robust_exposure(surface, measured, weights, Robust("geman-mcclure", cost.scales.colour))
    gain, bias = fitted.gain[0], fitted.bias[0]
    kept = cloud.coloured & ~clipped(fitted.applied(surface), measured)[0].any(0)
    moderate = (gain > 1 / STRONGEST) & (gain < STRONGEST) & (bias.abs() < MOST_BIAS)
    if not bool(moderate.all()) or float(kept.double().mean()) < LEAST_COLOURED:
        return cloud
    exposed = replace(cloud, rgb=((measured.mT - bias) / gain).clamp(0, 1).to(cloud.rgb), coloured=kept)
    _, then_alike = replace(cost, cloud=exposed).inliers(found)
    gained = float((near * (then_alike - alike))[0, kept].sum()) / len(cloud)
    return exposed if gained > CLEARLY_MORE else cloud
