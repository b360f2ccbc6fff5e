"""Search without landmarks: successive halving of many poses, with finer terms as fewer poses remain, and the verdict on the best pose.

A search ends with steps on rendered rays: at first few rays at the coarsest level, in the end many rays from a single pose.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import move_to, without_waiting
from bidnerf_core.errors import amount
from bidnerf_core.fields import RadianceField
from bidnerf_core.geometry import SE3, Robust
from bidnerf_core.localization.accept import DISPLACEMENT, Support, same_pose, support
from bidnerf_core.localization.loop import Loop
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Verdict, current_record
from bidnerf_core.localization.settings import (
    ColourSettings,
    DepthLossSettings,
    mean_side,
    rendered_depth_scale,
)
from bidnerf_core.localization.terms.rays import ALONE, RenderedRays
from bidnerf_core.mapping import CostTerm, States, damped_solution, descend
from bidnerf_core.progress import check_cancelled

SIGMA = 0.0024
"""Uncertainty of the map's surfaces in the first steps on rays that follow a search, relative to the scene's mean side."""


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage of a search: steps from all remaining poses; the best ``keep`` poses pass to the next stage."""

    terms: Sequence[CostTerm]
    steps: int
    keep: int
    score: Callable[[States], Float[Tensor, "h"]] | None = None  # by which poses are compared; None: the cost
    most: float = math.inf  # score of the best pose above which no pose can be accepted, and the search ends


@dataclass(frozen=True, eq=False)
class SearchResult:
    """The remaining poses of a search, and how much better the best one is than the best different one; on the CPU."""

    states: States  # (h), best first
    scores: Float[Tensor, "h"]
    margin: float  # score of the best different pose minus that of the best; infinite if there was none
    rivals: States  # the best poses that differ from the best one, of the last stage that had any
    before: States  # (1) the best pose before the last stage
    path: SE3  # (s + 1): from the winning hypothesis to the best pose
    losses: Float[Tensor, "s"]  # of the path before each step; costs of different stages are not comparable
    complete: bool  # whether all stages were run


def halve(
    start: States, stages: Iterable[Stage], middle: Float[Tensor, "3"], device: torch.device | str = "cpu"
) -> SearchResult:
    """Run the stages on the hypotheses ``start`` (h) and return the poses that remain.

    ``middle`` is the middle of the visible scene (metres, last camera's frame). If the best poses of a stage are all the same
    answer, the last of them is replaced by the best different pose. Steps are taken on ``device``; the host waits for the device
    between stages, but not within a stage.
    """
    states, middle = move_to(start, device), middle.to(device, torch.float64)
    poses, losses, margin, scores = [states.T[None]], list[Tensor](), float("inf"), states.noise
    rivals, before, complete = states[:0], states[:0], True
    for stage in stages:
        check_cancelled()
        path: list[tuple[SE3, Tensor]] = []
        before = states[:1]
        with without_waiting():
            states, here = descend(states, stage.terms, stage.steps, middle, path)
            scores = here.cost if stage.score is None else stage.score(states)
        order = scores.argsort()
        # Twice the displacement of a rival, since poses are still on their way to a minimum.
        other = order[~same_pose(states.T[order[0]], states.T[order], middle, 2 * DISPLACEMENT)]
        passing = order[: stage.keep]
        if len(other):
            # The best pose is compared with three others at most.
            margin, rivals = float(scores[other[0]] - scores[order[0]]), states[other[:3]]
            if stage.keep > 1 and not torch.isin(passing, other).any():
                passing = torch.cat([passing[:-1], other[:1]])
        if (record := current_record()) is not None:
            taken = f"after {stage.steps} steps from each" if stage.steps else "as they were drawn"
            record.add(f"{amount(len(scores), 'pose')} {taken}; {len(passing)} kept", states.T, scores, len(passing))
        poses += [T[None] for T, _ in path[1:]] + ([states.T[None]] if path else [])
        losses += [cost for _, cost in path]
        poses, losses = [T[:, passing] for T in poses], [values[passing] for values in losses]
        states, scores = states[passing], scores[passing]
        if float(scores[0]) > stage.most:
            complete = False
            break
    path_losses = torch.stack([values[0] for values in losses]) if losses else scores[:0]
    path_poses = SE3.cat([T[:, 0] for T in poses])
    return move_to(SearchResult(states, scores, margin, rivals, before, path_poses, path_losses, complete), "cpu")


def states_at(T: SE3) -> States:
    """Return static states with known cameras at the poses ``T`` (h)."""
    one = States.known(SE3.identity(), torch.zeros(6, dtype=torch.float64))
    return replace(one[torch.zeros(len(T.translation), dtype=torch.long)], T=T.to("cpu", torch.float64))


def draw_rays(
    problem: Problem,
    colour: ColourSettings,
    depth: DepthLossSettings | None,
    count: int,
    seed: int,
    field: RadianceField | None = None,
    blur: int = 1,
    sigma: float = 0.0,
) -> RenderedRays:
    """Draw ``count`` rays; return the term that compares their colours and, unless ``depth`` is None, their distances with renderings.

    ``field`` is the level of the map's field that is rendered; None for the field itself. Observed colours are averaged over squares of
    ``blur`` pixels. ``sigma`` is the uncertainty of the map's surfaces, relative to the scene's mean side.
    """
    bounds = problem.bounds
    if depth is not None and (depth.depth_weight == 0 or not problem.has_depth):
        depth = None
    own = None if depth is None else problem.depth_rays
    drawn = RenderedRays.of(
        problem.views, problem.field if field is None else field, bounds, max(7, count), seed, blur, own
    )
    found = replace(drawn, loss=Robust(colour.colour_loss, colour.colour_scale), sigma=sigma * mean_side(bounds))
    if depth is None:
        return found
    scale = depth.depth_scale or rendered_depth_scale(bounds) / 2
    return replace(found, depth_loss=Robust(depth.depth_loss, scale), depth_weight=depth.depth_weight)


def localization_by_rays(
    problem: Problem,
    loop: Loop | None,
    found: SearchResult,
    fresh: RenderedRays,
    middle: Float[Tensor, "3"],
    least_inliers: float,
) -> Localization:
    """Accept or reject the best pose of a search, using rays to which the pose was not fitted.

    The best poses of the last two stages are compared on these rays, and the better pose is judged. It must agree with the rays, lie at a
    minimum of their cost, and leave colour differences about as small as those in the map's own images; and the rays must distinguish the
    pose from its rivals and from a plain image.
    """
    some = States.cat([found.before, found.states[:1]])
    best = some[fresh.costs(some).sum(-1).argmin()[None]]
    T, here = best.T[0].normalized(), fresh.at(best)
    rays = replace(fresh, noise=here.fitted_noise(), independent=ALONE * len(problem.views))
    normal = move_to(replace(here, term=rays).normal(), "cpu")
    covariance = torch.linalg.inv_ex(normal.hessian[0, :6, :6]).inverse
    determined = bool(covariance.isfinite().all()) and float(torch.linalg.eigvalsh(covariance)[0]) > 0
    # The step as the shift of the visible scene, relative to its distance, and the rotation (radians).
    step = -damped_solution(normal, torch.zeros_like(normal.cost))[0, :6]
    shift = SE3.exp(step).apply(middle) - middle
    measures = support(lambda T: fresh.costs(states_at(T)), T, middle, fresh.plain_costs(), found.rivals.T)
    agreement, by_colour = float(here.agreement()[0]), fresh.depth_loss is None and problem.colour_noise
    measures |= {
        "determined": float(determined),
        "new_inliers": agreement,
        "further_step": float(torch.cat([shift / middle.norm(), step[3:]]).norm()),
        "colour_ratio": float(here.colour_noise()[0]) / by_colour if by_colour else None,
    }
    words = f"{agreement:.0%} of newly drawn rays agree with the measurements"
    path = SE3.cat([found.path[:-1], T[None]])
    loss = float(normal.cost) * float(rays.noise) ** 2 / rays.independent
    known = (covariance + covariance.mT) / 2 if determined else None
    judged = Support(measures, {"new_inliers": least_inliers})
    return conclude(problem, loop, path, found.losses, judged, words, loss, known)


def conclude(
    problem: Problem,
    loop: Loop | None,
    path: SE3,
    losses: Float[Tensor, "s"],
    judged: Support,
    accepted: str,
    loss: float,
    covariance: Float[Tensor, "6 6"] | None,
) -> Localization:
    """Return the answer at the end of a search's ``path``: that of the landmarks there if they accept it, else that of its measures.

    The path begins at the start, if there is one. ``accepted`` is the reason if they suffice.
    """
    began, there = time.perf_counter(), None if loop is None else loop.at(path[-1])
    if there is not None and there.verdict.accepted:
        found = there.localization(problem, began)
        return replace(found, reason=f"found on the surface; {found.reason}")
    # An approximate focal length does not matter to the points of another sensor.
    by_rays = problem.depth_rays is not None and not any(view.frame.has_depth for view in problem.views)
    more = {
        "confirmed": None if there is None else float(not there.contradicted),
        "known_focal": float(by_rays or not problem.focal_is_approximate),
    }
    judged = replace(judged, measures=judged.measures | more)
    path = path if problem.start is None else SE3.cat([problem.start[None], path[1:]])
    return Localization.of(judged.verdict(accepted), path, losses, "auto", began, loss, covariance, judged)


def without_pose(problem: Problem, why: Verdict) -> Localization:
    """Return the rejected answer for images that show nothing that could be localized; its pose is the start, or unknown without one."""
    path, none = (problem.start or SE3.unknown())[None], torch.zeros(0, dtype=torch.float64)
    return Localization.of(why, path, none, "auto", time.perf_counter(), float("nan"))
