"""Refinement on rendered rays, from many poses on few rays at the coarsest level to one pose on many rays, and its verdict."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import moved
from bidnerf_core.geometry import SE3, Robust
from bidnerf_core.localization.pivots import rendered_middle
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search import Proposals, Stage, states_at
from bidnerf_core.localization.settings import (
    ColourSettings,
    DepthLossSettings,
    RenderedThresholds,
    mean_side,
    rendered_depth_scale,
)
from bidnerf_core.localization.support import Support, support
from bidnerf_core.localization.terms.rays import ALONE, Rays
from bidnerf_core.mapping import States, damped_solution

NOISY = 1.8
"""Largest ratio of the colour differences at an accepted pose to those of the map's own images.

A wrong pose can be the best one far around, so that rival poses nearby are no better, but its colours differ more. On test images of
Lego and the room, the ratio was 0.8 to 1.4 at right poses, and 2.1 and more at wrong ones.
"""
SHAPE_SIGMA, COLOUR_SIGMA = 0.012, 0.0024
"""Uncertainty of the map's surfaces in coarse steps, relative to the scene's mean side: with depth, and by colour alone from a search."""


@dataclass(frozen=True)
class RayStage:
    """A stage: steps from all remaining poses on one draw of rays, the best ``keep`` of which pass to the next stage."""

    steps: int
    rays: int  # per pose
    keep: int = 1
    level: int | None = None  # of the field: 0 is the coarsest, None the field itself
    blur: int = 1  # width, in pixels, of the squares over which observed colours are averaged
    wide: float = 1.0  # factor of the scales of the losses
    sigma: float = 0.0  # uncertainty of the map's surfaces, relative to the scene's mean side


@dataclass(frozen=True)
class RayTerms:
    """What is compared along rendered rays."""

    colour: ColourSettings
    depth: DepthLossSettings | None  # None: colour alone
    exposure: bool = True

    def term(self, problem: Problem, stage: RayStage, seed: int) -> Rays:
        """Draw the rays of a stage and return the term."""
        depth, bounds = self.depth, problem.bounds
        if depth is not None and (depth.depth_weight == 0 or not problem.has_depth):
            depth = None
        own = None if depth is None else problem.depth_rays
        drawn = Rays.of(problem.views, problem.level(stage.level), bounds, stage.rays, seed, stage.blur, own)
        loss = Robust(self.colour.colour_loss, stage.wide * self.colour.colour_scale)
        found = replace(drawn, loss=loss, exposure=self.exposure, sigma=stage.sigma * mean_side(bounds))
        if depth is None:
            return found
        scale = depth.depth_scale or rendered_depth_scale(bounds) / 2
        by_depth = Robust(depth.depth_loss, stage.wide * scale)
        return replace(found, depth_loss=by_depth, depth_weight=depth.depth_weight)

    def stages(self, problem: Problem, stages: Sequence[RayStage], seed: int) -> Iterator[Stage]:
        """Yield the stages of a search, each with a draw of its own."""
        for number, stage in enumerate(stages):
            yield Stage([self.term(problem, stage, seed + number)], stage.steps, stage.keep)


@torch.no_grad()
def centred(problem: Problem, T: SE3, middle: Float[Tensor, "3"]) -> SE3:
    """Return the poses T (h) after shifting each camera to align the median of the rendered points with the measured ``middle``.

    Where a scene is seen from outside, the main error is often that it appears in another part of the image. This removes it with
    one rendering of a few rays, even where the loss has no useful gradient. A pose is unchanged if nothing is rendered.
    """
    shift = rendered_middle(problem.level(0), problem.bounds, problem.views, T).cpu().double() - middle
    shift = torch.where(shift.isfinite(), shift, 0)
    return SE3(T.rotation, T.translation + (T.rotation @ shift[..., None])[..., 0])


def localization_by_rays(
    problem: Problem, found: Proposals, fresh: Rays, middle: Float[Tensor, "3"], thresholds: RenderedThresholds,
    method: str, began: float,
) -> Localization:  # fmt: skip
    """Accept or reject the best pose of a search by rays to which it was not fitted.

    It is the better of the last two stages' poses on these rays. It must agree with them, be where they have a minimum, and leave
    differences of colour as small as in the map's own images; and they must distinguish it from its rivals and from a plain image.
    """
    device = fresh.rgb.device
    some = States.cat([found.before, found.states[:1]])
    chosen = int(fresh.costs(some).sum(-1).argmin())
    best = some[chosen : chosen + 1]
    T, here = best.T[0].normalized(), fresh.at(moved(best, device))
    agreement, noise = float(here.agreement()[0]), float(here.colour_noise()[0])
    rays = replace(fresh, noise=here.fitted_noise(), independent=ALONE * len(problem.views))
    normal = moved(replace(here, term=rays).normal(), "cpu")
    covariance = torch.linalg.inv_ex(normal.hessian[0, :6, :6]).inverse
    determined = bool(covariance.isfinite().all()) and float(torch.linalg.eigvalsh(covariance)[0]) > 0
    # A step of the visible scene, relative to its distance, and its turn.
    step = -damped_solution(normal, torch.zeros_like(normal.cost))[0, :6]
    shift = SE3.exp(step).apply(middle) - middle
    length = float(torch.cat([shift / middle.norm(), step[3:]]).norm())
    compared = support(
        lambda T: fresh.costs(states_at(T)), T, middle, fresh.plain_costs(), found.rivals.T
    ) if bool(T.matrix().isfinite().all()) else Support(0.0, 0.0, 0.0, 0.0)  # fmt: skip
    share = f"{agreement:.0%} of newly drawn rays agree with the measurements"
    verdict = Verdict(Outcome.CONVERGED, share, compared.confidence)
    if not determined:
        verdict = Verdict(Outcome.UNDETERMINED, "the measurements do not determine the pose")
    elif not agreement >= thresholds.converged_inliers:
        least = f"expected {thresholds.converged_inliers:.0%}"
        verdict = Verdict(Outcome.RENDERING_MISMATCH, f"{share}, {least}")
    elif (rejection := compared.rejection()) is not None:
        verdict = rejection
    elif not length <= thresholds.converged_step:
        most = f"expected {thresholds.converged_step:g} at most"
        verdict = Verdict(
            Outcome.NOT_SETTLED, f"newly drawn rays give a further step of {length:.3g}, {most}"
        )
    elif fresh.depth_loss is None and problem.colour_noise and not noise <= NOISY * problem.colour_noise:
        known = f"{problem.colour_noise:.2g} in the map's own images"
        verdict = Verdict(Outcome.RENDERING_MISMATCH, f"the colours differ by {noise:.2g}, but by {known}")
    path = found.path if problem.start is None else SE3.cat([problem.start[None], found.path[1:]])
    path = SE3.cat([path[:-1], T[None]]) if len(path.translation) > 1 else path
    return Localization(
        T_world_camera=T,
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=len(found.losses),
        seconds=time.perf_counter() - began,
        loss=float(normal.cost) * rays.noise**2 / rays.independent,
        method=method,
        poses=path,
        losses=found.losses,
        covariance=(covariance + covariance.mT) / 2 if determined else None,
        confidence=verdict.confidence,
        diagnostics=compared,
    )
