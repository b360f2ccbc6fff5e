"""Localization on the baked surface of a map without landmarks: by measured depth, or by comparing images with its renderings."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.by_rays import COLOUR_SIGMA, RayStage, RayTerms, localization_by_rays
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search import Proposals, by_depth, by_images, halve, judge, states_at
from bidnerf_core.localization.settings import AutoConfig, ColourSettings, DepthLossSettings
from bidnerf_core.localization.support import SurfaceDiagnostics, support
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import States, SurfaceMap, descend, trace

WORSE = 0.05
"""Maximum increase of the cost on the surface by refinement; beyond it, field and surface contradict each other."""
WELL_BEFORE = 0.04
"""Fraction of the extent by which a line of sight must hit the surface too early to count as a violation."""
SIGHT_LINES = 300
"""Maximum number of lines of sight that are traced."""
FLAT = 0.02
"""Standard deviation of an image's colours, in [0, 1], below which a gain and an offset can fit any view to it."""
BY_DEPTH = RayTerms(ColourSettings(), DepthLossSettings(depth_weight=1.0))
FIELD_SIGMA = 0.003
"""Uncertainty of a field's surfaces in second-order steps from a nearly correct pose, relative to the scene's mean side."""
MANY_RAYS = 4
"""Factor by which more rays are rendered if part of the scene may be hidden."""


def localize_by_depth(problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int) -> Localization:
    """Align measured points with the surface, in rounds until a pose is acceptable, then refine it on rendered rays as well."""
    began = time.perf_counter()
    points = Surface.of(problem.views, problem.depth_rays, surface, seed, config.points)
    if points is None:
        raise ValueError("too few points were measured")
    middle = points.points.median(0).values.cpu()
    with torch.no_grad():
        found: Proposals | None = None
        for number in range(config.rounds):
            again = by_depth(problem, points, config.hypotheses, seed + number)
            found = again if found is None or again.scores[0] < found.scores[0] else found
            best, exposed = _exposed(points, found.states[:1], middle)
            diagnostics = _diagnostics(exposed, best, found.margin)
            if diagnostics.rejection() is None:
                break
    assert found is not None
    finest = replace(exposed, noise=surface.cell, colour_weight=1.0)
    path, losses = found.path, found.losses
    refined = finest.fitted_noise(best)
    if config.refine_steps:
        stage = RayStage(config.refine_steps, config.refine_rays, sigma=FIELD_SIGMA)
        term = BY_DEPTH.term(problem, stage, seed)
        rays = replace(term, noise=problem.colour_noise or term.noise)
        steps: list[tuple[SE3, Tensor]] = []
        there, _ = descend(best, [refined, rays], config.refine_steps, middle, steps)
        inliers = 0.0
        if float(_score(exposed, there)) <= float(_score(exposed, best)) + WORSE:
            path = SE3.cat([path, *(T for T, _ in steps[1:]), there.T])
            losses = torch.cat([losses, *(cost for _, cost in steps)])
            best, inliers = there, float(term.agreement(there)[0])
        diagnostics = replace(_diagnostics(exposed, best, found.margin), rendered_inliers=inliers)
    with torch.no_grad():
        T = best.T[0].normalized()
        compared = support(lambda T: finest.costs(states_at(T)), T, middle)
        diagnostics = replace(diagnostics, support=compared)
        verdict = diagnostics.verdict()
        covariance = _covariance(problem, refined, best, middle)
    if problem.start is not None:
        path = SE3.cat([problem.start[None], path[1:]])
    return Localization(
        T_world_camera=T,
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=len(path.translation) - 1,
        seconds=time.perf_counter() - began,
        loss=float(_score(exposed, best)),
        method="auto",
        poses=path,
        losses=losses[: len(path.translation) - 1],
        covariance=covariance,
        confidence=verdict.confidence,
        diagnostics=diagnostics,
    )


def _score(points: Surface, states: States) -> Float[Tensor, ""]:
    return judge(points).costs(states).mean(-1)[0]


def _exposed(points: Surface, best: States, middle: Float[Tensor, "3"]) -> tuple[States, Surface]:
    """Align a pose again with the points' colours converted to the map's exposure; return it and the points."""
    exposed = judge(points).exposed(best)
    found = replace(points, rgb=exposed.rgb)
    if exposed.rgb is points.rgb:
        return best, points
    finest = replace(found, noise=points.surface.cell, colour_weight=1.0)
    return descend(best, [finest], 4, middle)[0], found


def _diagnostics(points: Surface, best: States, margin: float) -> SurfaceDiagnostics:
    """Measure how well the points, seen from one pose, fit the surface; each counts by its inlier weight.

    Points without a colour do not count for the colour inliers, unless no point has a colour.
    """
    near, alike = judge(points).inliers(best)
    coloured = (points.coloured > 0).to(near.device)
    both = (near * alike)[:, coloured] if bool(coloured.any()) else near
    some, surface = points.points[:SIGHT_LINES], points.surface
    T = best.T[0].to(surface.device)
    ends, origin = T.apply(some), T.apply(points.origins[:SIGHT_LINES])
    length = (ends - origin).norm(dim=-1).float()
    met = trace(surface, origin.float(), ((ends - origin).float() / length.clamp(min=1e-9)[:, None]))
    # Grazing rays hit coarse cells early.
    slack = max(WELL_BEFORE * surface.extent, 4 * surface.cell)
    violations = float((met < length - slack).double().mean())
    return SurfaceDiagnostics(float(near.mean()), float(both.mean()), violations, margin)


def _covariance(
    problem: Problem, points: Surface, best: States, middle: Float[Tensor, "3"]
) -> Float[Tensor, "6 6"]:
    """Return the covariance of a pose that aligns measured points with the surface; positive definite.

    Along directions that the points do not determine, such as that of a bare wall, the standard deviation is the size of the scene
    or half a turn. The uncertainties of the sensor's scale and offset, which all points share, are added.
    """
    prior = torch.tensor([points.surface.extent] * 3 + [math.pi] * 3, dtype=torch.float64)
    about = torch.eye(6, dtype=torch.float64)
    about[:3, 3:] = torch.linalg.cross(middle.expand(3, 3), about[:3, :3]).mT
    hessian = about.mT @ points(best).hessian[0, :6, :6] @ about
    found = torch.linalg.inv(hessian + torch.diag(prior**-2))
    sight = torch.nn.functional.normalize((points.points - points.origins).cpu(), dim=-1).mean(0)
    for change in (problem.sensor.scale * middle, problem.sensor.offset * sight):
        shared = torch.cat([-change, torch.zeros(3, dtype=torch.float64)])
        found = found + shared[:, None] * shared
    found = about @ found @ about.mT
    return (found + found.mT) / 2


def localize_by_images(
    problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int, hopeless: Verdict | None = None
) -> Localization:
    """Compare the images with renderings of the surface, in rounds until an answer is accepted, and refine each answer.

    The first round is fast. The others assume that part of the scene is hidden. If no answer is accepted, the one with the
    smallest loss is returned. With a reason why it is ``hopeless``, the best pose of one search is rejected without
    refinement, which would take many seconds.
    """
    began, c = time.perf_counter(), config.by_colour
    problem = problem.without_depth()
    if all(is_blank(view.frame) for view in problem.views):
        hopeless = Verdict(Outcome.UNDETERMINED, "the image has a single colour, as if the lens were covered")
    coarse = RayStage(c.steps.coarse_steps, c.steps.coarse_rays, 2, 0, 2, sigma=COLOUR_SIGMA)
    fine = RayStage(c.steps.fine_steps, c.steps.fine_rays, 1, sigma=COLOUR_SIGMA / 2)
    answers = list[tuple[float, Localization]]()
    for number in range(config.rounds):
        detailed = number > 0
        with torch.no_grad():
            found = by_images(problem, surface, config.hypotheses, seed + number, detailed)
        if hopeless is not None:
            return Localization(
                found.states.T[0].normalized(), hopeless.outcome, hopeless.reason, len(found.losses),
                time.perf_counter() - began, float(found.scores[0]), "auto", found.path, found.losses,
            )  # fmt: skip
        # If half of the rays are outliers, refinement on few rays or at a coarse level drifts away from the true pose.
        stages = [replace(fine, rays=MANY_RAYS * fine.rays, wide=0.5)] if detailed else [coarse, fine]
        colour = replace(c.colour, colour_loss="geman-mcclure") if detailed else c.colour
        middle = found.middle
        terms = RayTerms(colour, None)
        start = found.states[:1] if detailed else found.states
        refined = found.then(halve(start, terms.stages(problem, stages, seed), middle))
        fresh = RayTerms(c.colour, None).term(problem, fine, seed + len(stages))
        answer = localization_by_rays(problem, refined, fresh, middle, c.thresholds, "auto", began)
        if answer.converged:
            return answer
        answers.append((answer.loss, answer))
    return min(answers, key=lambda answer: answer[0])[1]


def is_blank(frame: Frame) -> bool:
    """Return whether the image has a single colour, as if the lens were covered, or the frame has no colours at all."""
    shown = frame.rgb.flatten(0, 1) if frame.hidden is None else frame.rgb[~frame.hidden]
    return not frame.has_colour or float(shown.std(0, correction=0).max()) < FLAT
