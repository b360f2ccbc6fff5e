"""Coarse-to-fine second-order refinement on rendered rays, for any differentiable field.

Each stage draws its rays once, so that a step that does not lower the cost can be detected and undone. Poses are refined in
batches, and each stage continues with the best of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.devices import may_wait, without_waiting
from bidnerf_core.fields import Observations, RadianceField, SceneBounds, render
from bidnerf_core.geometry import SE3, USUAL
from bidnerf_core.localization.adam import History
from bidnerf_core.localization.costs.linearization import flattened
from bidnerf_core.localization.costs.rendered import RenderedCost, RenderedCostSettings
from bidnerf_core.localization.costs.surface import SurfaceCost
from bidnerf_core.localization.covariance import sandwich_covariance, weight
from bidnerf_core.localization.normal_equations import NormalEquations, Scaled
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.settings import RefinementStage
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.localization.solvers.pivots import pivot
from bidnerf_core.localization.support import Support, support

RIVALS = 3
"""Maximum number of other poses found with which the best one is compared."""


@dataclass(frozen=True, eq=False)
class RefinementResult:
    """The best pose, and its assessment on rays not used in the fit."""

    T: SE3
    loss: float  # by the last stage's measure
    inliers: float  # inlier fraction of the rays
    covariance: Float[
        Tensor, "6 6"
    ]  # of a right update at the camera: translation (metres), rotation (radians)
    step: float  # length of the Gauss-Newton step on these rays (metres, radians)
    poses: SE3  # (steps + 1): the first given pose, then the best one after each step
    losses: Float[Tensor, "s"]  # before each step
    fresh: RenderedCost  # cost of these rays
    rivals: SE3 | None  # other poses that were found

    @cached_property
    def support(self) -> Support:
        """How well these rays distinguish the pose from its rivals, at which they are rendered too."""
        return rendered_support(self.fresh, self.T, self.rivals)


def refine(
    problem: Problem,
    start: SE3,
    stages: Sequence[RefinementStage],
    settings: RenderedCostSettings,
    generator: Generator,
) -> RefinementResult:
    """Refine poses (h), keeping the best in each stage; ``problem.start`` is not used.

    The result is the better of the last two stages' poses on rays to which neither was fitted. Its rivals are the next best
    poses of the last stage that had several.
    """
    about = pivot(settings.refinement.pivot, replace(problem, start=start[0])).to(problem.device)
    history = History([start[0].to("cpu")])
    problem, T, ends = problem.on_device(), start.to(problem.device), []
    rivals: SE3 | None = None
    for stage in stages:
        cost = settings.drawn(problem, stage, about, generator)
        for _ in range(stage.centring):
            T = centred(cost.field, cost.rays.observed, problem.bounds, T)
        T = _ranked(cost, T, history) if stage.steps == 0 else _descended(cost, T[: stage.keep], history)
        ends.append(T[0])
        rivals = T[1 : 1 + RIVALS] if len(T.translation) > 1 else rivals
    fresh = settings.drawn(problem, stages[-1], about, generator)
    return _assessed(fresh, SE3.stack(ends[-2:]), rivals, history)


@dataclass(frozen=True, eq=False)
class FewSteps:
    """The result of ``take_few_steps``."""

    poses: SE3  # (s + 1)
    inliers: float  # inlier fraction of the rays, of those with depth if at least 5 % have it


def take_few_steps(
    problem: Problem, start: SE3, stage: RefinementStage, settings: RenderedCostSettings, generator: Generator,
    surface: SurfaceCost | None = None,
) -> FewSteps:  # fmt: skip
    """Take up to ``stage.steps`` second-order steps from a nearly correct pose, on one draw of rays.

    With the cost of measured points on the ``surface``, the steps minimize the sum of both, each divided by the variance of its
    residuals at the start, so a badly rendering field hardly moves a pose that the surface determines well. It stops before a
    step that would not lower the cost. The last pose is assessed on the same rays and without derivatives, at half the cost of
    ``refine``.
    """
    device, name, views = problem.device, settings.refinement.pivot, len(problem.views)
    about = pivot(name, replace(problem, start=start)) if surface is None else surface.cloud.pivot
    about, start = about.to(device), start.to(device)
    cost = settings.drawn(problem.on_device(), stage, about, generator)
    poses, inliers, lower = [start], list[Tensor](), list[Tensor]()
    with without_waiting():
        here = cost.residuals(poses[0][None])
        inliers.append(here.inliers_by_depth()[0])
        rendered = weight(USUAL.rays * views, float(here.cost()[0]))
        beside = (
            None
            if surface is None
            else Scaled(
                surface,
                weight(USUAL.points * views, float(surface.residual_variance(start[None])[0])),
            )
        )
        aligned = None if beside is None else beside(start[None])
        for left in reversed(range(stage.steps)):
            equations = _sum(here.normal_equations().scaled(rendered), aligned)
            delta = equations.solve(torch.full_like(equations.cost, stage.damping))
            trial = about.moved(poses[-1][None], delta)
            here = cost.residuals(trial, derivatives=left > 0)
            aligned = None if beside is None else beside(trial)
            reached = rendered * here.cost() + (0 if aligned is None else aligned.cost)
            lower.append(reached[0] < equations.cost[0])
            if may_wait(device) and not bool(lower[-1]):
                break
            poses.append(trial[0])
            inliers.append(here.inliers_by_depth()[0])
    # Where the host must not wait for the device, steps after the first that did not lower the cost are discarded here.
    count = 1 + int(torch.stack(lower).cpu().cumprod(0).sum() if lower else 0)
    return FewSteps(SE3.stack(poses[:count]).to("cpu"), float(inliers[count - 1]))


def _sum(equations: NormalEquations, others: NormalEquations | None) -> NormalEquations:
    return equations if others is None else equations + others


def _ranked(cost: RenderedCost, T: SE3, history: History) -> SE3:
    costs = cost.cost(T)
    order = costs.argsort()
    history.poses.append(T[order[0]].to("cpu"))
    history.losses.append(float(costs[0]) / 2)
    return T[order]


def _descended(cost: RenderedCost, T: SE3, history: History) -> SE3:
    stage = cost.stage
    with without_waiting():
        found = descend(cost, T, stage.steps, cost.pivot.moved, stage.damping, cost.settings.stop_step)
    poses, costs = found.poses.to("cpu"), found.costs.cpu()
    best = costs.argmin(-1).tolist()
    history.poses += [poses[i, best[i]] for i in range(1, len(best))]
    history.losses += (costs.amin(-1)[:-1] / 2).tolist()
    return found.T[found.equations.cost.argsort()].normalized()


def _assessed(cost: RenderedCost, T: SE3, rivals: SE3 | None, history: History) -> RefinementResult:
    T, about = T.to("cpu"), cost.pivot.to(torch.device("cpu"))
    residuals = cost.residuals(T)
    equations = residuals.normal_equations()
    best = int(equations.cost.argmin())
    history.poses[-1] = T[best]
    covariance = sandwich_covariance(residuals.scores(), equations.hessian)[best]
    return RefinementResult(
        T=T[best],
        loss=float(equations.cost[best]) / 2,
        inliers=float(residuals.inliers()[best]),
        covariance=about.at_camera(T[best], covariance),
        step=float(torch.linalg.vector_norm(equations.solve(torch.zeros_like(equations.cost))[best])),
        poses=SE3.stack(history.poses),
        losses=torch.tensor(history.losses, dtype=torch.float64),
        fresh=cost,
        rivals=rivals,
    )


@torch.no_grad()
def rendered_support(cost: RenderedCost, T: SE3, rivals: SE3 | None = None) -> Support:
    """Return how well rendered rays distinguish a pose from its rivals, which include ``rivals`` (h)."""
    problem = cost.problem
    if not bool(T.matrix().isfinite().all()):
        return Support(0.0, 0.0, 0.0, 0.0)
    middle = (
        rendered_middle(cost.field, cost.rays.observed, problem.bounds, T[None].to(problem.device))[0]
        .cpu()
        .double()
    )
    if not bool(middle.isfinite().all()):  # nothing is rendered
        centre = torch.tensor(problem.bounds.centre, dtype=torch.float64)
        middle = T.to("cpu", torch.float64).inverse().apply(centre)
    return support(cost.ray_costs, T, middle, cost.plain_ray_costs(), rivals)


@torch.no_grad()
def centred(field: RadianceField, observed: Observations, bounds: SceneBounds, T: SE3) -> SE3:
    """Return the poses T (h) after shifting each camera to align the medians of the rendered and the measured points.

    At a wrong start, the main error is that the scene appears in another part of the image. This removes it with one rendering of a
    few rays, even where the loss has no useful gradient. A pose is unchanged if nothing is measured or nothing is rendered.
    """
    points = torch.where(observed.measured[:, None], observed.points, torch.nan)
    measured = points.nanmedian(0).values  # NaN where nothing was measured
    shift = rendered_middle(field, observed, bounds, T) - measured
    shift = torch.where(shift.isfinite(), shift, 0).to(T.translation)
    return SE3(T.rotation, T.translation + (T.rotation @ shift[..., None])[..., 0])


def rendered_middle(
    field: RadianceField, observed: Observations, bounds: SceneBounds, T: SE3
) -> Float[Tensor, "h 3"]:
    """Return the median of the rendered points along each axis, in the last camera's frame; NaN if no ray hits anything."""
    rays = observed.rays(T, bounds)
    shape = rays.near.shape
    seen = render(field, flattened(rays), bounds.background)
    distance = torch.where(seen.opacity > 0.5, seen.distance / seen.opacity.clamp(min=0.5), torch.nan)
    points = observed.origins + distance.reshape(shape)[..., None] * observed.directions
    return points.nanmedian(1).values
