"""Pose refinement on rendered rays, from many poses with few rays at the coarsest level to one pose with many rays; and its verdict."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import moved
from bidnerf_core.geometry import SE3, Robust
from bidnerf_core.localization.accept import Support, support
from bidnerf_core.localization.problem import Problem, rendered_middle
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.search import SearchResult, Stage, states_at
from bidnerf_core.localization.settings import (
    ColourSettings,
    DepthLossSettings,
    RefinementSettings,
    mean_side,
    rendered_depth_scale,
)
from bidnerf_core.localization.terms.rays import ALONE, RenderedRays
from bidnerf_core.mapping import States, damped_solution

SHAPE_SIGMA = 0.012
"""Uncertainty of the map's surfaces in coarse steps with depth, relative to the scene's mean side."""
COLOUR_SIGMA = SHAPE_SIGMA / 5
"""Uncertainty of the map's surfaces in steps by colour alone from a search, relative to the scene's mean side."""


@dataclass(frozen=True)
class RayTerms:
    """The settings for comparing colours and, optionally, depths along rendered rays."""

    colour: ColourSettings
    depth: DepthLossSettings | None  # None: colour alone
    exposure: bool = True

    def term(
        self, problem: Problem, count: int, seed: int, level: int | None = None, blur: int = 1,
        wide: float = 1.0, sigma: float = 0.0,
    ) -> RenderedRays:  # fmt: skip
        """Draw ``count`` rays and return their residual term at a level of the field (0 is the coarsest, None the field itself).

        Observed colours are averaged over squares of ``blur`` pixels. ``wide`` multiplies the scales of the losses, and ``sigma``
        is the uncertainty of the map's surfaces, relative to the scene's mean side.
        """
        depth, bounds = self.depth, problem.bounds
        if depth is not None and (depth.depth_weight == 0 or not problem.has_depth):
            depth = None
        own = None if depth is None else problem.depth_rays
        drawn = RenderedRays.of(problem.views, problem.level(level), bounds, max(7, count), seed, blur, own)
        loss = Robust(self.colour.colour_loss, wide * self.colour.colour_scale)
        found = replace(drawn, loss=loss, exposure=self.exposure, sigma=sigma * mean_side(bounds))
        if depth is None:
            return found
        scale = depth.depth_scale or rendered_depth_scale(bounds) / 2
        return replace(
            found, depth_loss=Robust(depth.depth_loss, wide * scale), depth_weight=depth.depth_weight
        )


def colour_stages(problem: Problem, terms: RayTerms, steps: RefinementSettings, seed: int) -> Iterator[Stage]:
    """Yield two stages: few rays at the coarsest level from each pose, then full detail from the two best, keeping the better."""
    coarse = terms.term(problem, steps.fine_rays // 4, seed, level=0, blur=2, sigma=COLOUR_SIGMA)
    yield Stage([coarse], min(4, steps.fine_steps), 2)
    yield Stage([terms.term(problem, steps.fine_rays, seed + 1, sigma=COLOUR_SIGMA / 2)], steps.fine_steps, 1)


@torch.no_grad()
def centred(problem: Problem, T: SE3, middle: Float[Tensor, "3"]) -> SE3:
    """Return the poses T (h), each camera shifted so that the median rendered point coincides with the measured ``middle``.

    When a scene is seen from outside, the main error is often that the scene appears in the wrong part of the image. The shift
    removes this error with one rendering of a few rays, even where the loss has no useful gradient. A pose is
    unchanged if nothing is rendered.
    """
    shift = rendered_middle(problem.level(0), problem.bounds, problem.views, T).cpu().double() - middle
    shift = torch.where(shift.isfinite(), shift, 0)
    return SE3(T.rotation, T.translation + (T.rotation @ shift[..., None])[..., 0])


def localization_by_rays(
    problem: Problem, found: SearchResult, fresh: RenderedRays, middle: Float[Tensor, "3"], least_inliers: float,
    method: str, began: float,
) -> Localization:  # fmt: skip
    """Accept or reject the best pose of a search, using rays to which the pose was not fitted.

    The best poses of the last two stages are compared on these rays, and the better pose is judged. It must agree with the rays, lie at
    a minimum of their cost, and leave colour differences as small as in the map's own images; and the rays must distinguish the pose
    from its rivals and from a plain image.
    """
    some = States.cat([found.before, found.states[:1]])
    best = some[fresh.costs(some).sum(-1).argmin()[None]]
    T, here = best.T[0].normalized(), fresh.at(moved(best, fresh.rgb.device))
    rays = replace(fresh, noise=here.fitted_noise(), independent=ALONE * len(problem.views))
    normal = moved(replace(here, term=rays).normal(), "cpu")
    covariance = torch.linalg.inv_ex(normal.hessian[0, :6, :6]).inverse
    determined = bool(covariance.isfinite().all()) and float(torch.linalg.eigvalsh(covariance)[0]) > 0
    # A step of the visible scene, relative to its distance, and its turn.
    step = -damped_solution(normal, torch.zeros_like(normal.cost))[0, :6]
    shift = SE3.exp(step).apply(middle) - middle
    measures: dict[str, float | None] = {"plain": 0.0, "confidence": 0.25}
    if bool(T.matrix().isfinite().all()):
        costs = fresh.plain_costs()
        measures = support(lambda T: fresh.costs(states_at(T)), T, middle, costs, found.rivals.T)
    agreement, by_colour = float(here.agreement()[0]), fresh.depth_loss is None and problem.colour_noise
    measures |= {
        "determined": float(determined),
        "new_inliers": agreement,
        "further_step": float(torch.cat([shift / middle.norm(), step[3:]]).norm()),
        "colour_ratio": float(here.colour_noise()[0]) / by_colour if by_colour else None,
    }
    compared = Support(measures, {"new_inliers": least_inliers})
    verdict = compared.verdict(f"{agreement:.0%} of newly drawn rays agree with the measurements")
    path = found.path if problem.start is None else SE3.cat([problem.start[None], found.path[1:]])
    path = SE3.cat([path[:-1], T[None]])
    loss = float(normal.cost) * float(rays.noise) ** 2 / rays.independent
    covariance = (covariance + covariance.mT) / 2
    return Localization.of(
        verdict, path, found.losses, method, began, loss, covariance if determined else None, compared
    )
