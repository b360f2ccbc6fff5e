"""The loss of a pose on sampled rays (eq. 6), for first-order solvers."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor

from bidnerf_core.devices import constant
from bidnerf_core.fields import Objective, Observations, Rays, SceneBounds, masked_mean, render, widened
from bidnerf_core.frames import DRAWERS, Frame, draw
from bidnerf_core.geometry import SE3, Robust
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.settings import DescentSettings, ReachSettings, rendered_depth_scale

DIFFERENT = 0.02
"""Colour difference from the background, in [0, 1], above which a pixel shows matter."""
LITTLE_BACKGROUND = 0.02
"""Fraction of an image's pixels without matter below which preferring the other pixels is not worth its cost."""


@dataclass(eq=False)
class SampledLoss:
    """The loss of a pose on pixels that are drawn at each call or only once."""

    problem: Problem
    objective: Objective
    depth_rays: int  # number of rays drawn from a sensor with rays of its own
    rays: DescentSettings
    reach: ReachSettings
    generator: Generator
    _batches: list[Observations] | None = field(default=None, init=False)
    _candidates: int = field(default=1, init=False)

    def __post_init__(self) -> None:
        if self.reach.candidates > 1 and _shows_background(self.problem):
            self._candidates = self.reach.candidates

    def __call__(self, T_world_last: SE3) -> Float[Tensor, ""]:
        """Return the loss; differentiable in the pose of the last view's camera."""
        if self._batches is None or self.rays.renew:
            self._batches = self._drawn(T_world_last.detach())
        first, *others = (self._loss(batch, T_world_last) for batch in self._batches)
        return sum(others, start=first)

    def _loss(self, observed: Observations, T_world_last: SE3) -> Float[Tensor, ""]:
        scene, rays = self.problem.level(self.rays.level), self._rays(observed, T_world_last)
        bounds, weight = self.problem.bounds, self.reach.box_weight
        loss = self.objective.loss(render(scene, rays, bounds.background), observed)
        boxed = weight > 0 and self.objective.uses_depth and not bounds.contracted
        return loss + weight * self._outside(rays, observed) if boxed else loss

    def _rays(self, observed: Observations, T_world_last: SE3) -> Rays:
        rays = observed.rays(T_world_last, self.problem.bounds)
        return rays if self.rays.wide == 1 else widened(rays, self.rays.wide)

    def _outside(self, rays: Rays, observed: Observations) -> Float[Tensor, ""]:
        """Return the mean robust loss of the distances (metres) between measured points and the box of the scene."""
        bounds = self.problem.bounds
        points = rays.origins + observed.distance[..., None] * rays.directions
        half = constant(bounds.size, points) / 2
        off = ((points - constant(bounds.centre, points)).abs() - half).clamp(min=0)
        robust = Robust("huber", rendered_depth_scale(bounds))
        return masked_mean(robust(torch.linalg.vector_norm(off, dim=-1)), observed.measured).mean()

    def _drawn(self, T_world_last: SE3) -> list[Observations]:
        """Draw pixels (views, pixels per view) and any depth rays (1, rays)."""
        problem, device = self.problem, self.problem.device
        many = self.rays.rays * self._candidates
        pixels = draw(problem.views, many, DRAWERS[self.rays.pixels], self.generator, device=device)
        if self._candidates > 1:
            count = max(1, self.rays.rays // len(problem.views))
            order = self._rank(pixels, T_world_last).sort(dim=-1, descending=True, stable=True).indices
            pixels = pixels.gathered(order[:, :count])
        batches = [pixels]
        if problem.depth_rays is not None and self.objective.uses_depth and self.depth_rays > 0:
            batches.append(problem.depth_rays.drawn(self.depth_rays, self.generator, device=device)[None])
        return batches

    def _rank(self, pixels: Observations, T_world_last: SE3) -> Int[Tensor, "k p"]:
        """Return 2 or more for pixels that show matter in the image, and 1 for others whose rays may hit it in the map."""
        background = constant(self.problem.bounds.background, pixels.rgb)
        shows = pixels.measured | ((pixels.rgb - background).abs().amax(-1) > DIFFERENT)
        sampler = self.problem.level(self.rays.level).sampler
        return 2 * shows.int() + sampler(self._rays(pixels, T_world_last)).valid.any(-1).int()


def _shows_background(problem: Problem) -> bool:
    """Return whether more than a few pixels of any image have the background's colour and no measured depth."""
    return any(_share_of_background(view.frame, problem.bounds) > LITTLE_BACKGROUND for view in problem.views)


def _share_of_background(frame: Frame, bounds: SceneBounds) -> float:
    """Return the fraction of the pixels with the background's colour and without measured depth."""
    plain = ((frame.rgb - constant(bounds.background, frame.rgb)).abs() <= DIFFERENT).all(-1)
    plain = plain if frame.depth is None else plain & (frame.depth <= 0)
    return float((plain if frame.hidden is None else plain[~frame.hidden]).float().mean())
