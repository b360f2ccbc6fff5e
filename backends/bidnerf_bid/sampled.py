"""The loss of a pose on sampled rays (eq. 6), for first-order solvers."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_bid.pixels import DRAWERS
from bidnerf_bid.residuals import Objective, masked_mean
from bidnerf_bid.settings import DescentSettings, ReachSettings
from bidnerf_core.devices import constant
from bidnerf_core.fields import Observations, Rays, render, widen
from bidnerf_core.frames import draw
from bidnerf_core.geometry import SE3, Robust
from bidnerf_core.localization import Problem, rendered_depth_scale

DIFFERENT = 0.02
"""Colour difference from the background, in [0, 1], above which a pixel shows matter."""


@dataclass(eq=False)
class SampledLoss:
    """The loss of a pose on pixels that are newly drawn at each call."""

    problem: Problem
    objective: Objective
    depth_rays: int  # number of rays drawn from a sensor with rays of its own
    rays: DescentSettings
    reach: ReachSettings
    generator: Generator

    def __post_init__(self) -> None:
        problem = self.problem
        self._field, self._bounds = self.rays.level_of(problem.field), problem.bounds
        # Extra candidates are worth their cost only if more than 2 % of pixels have the background's colour and no depth.
        self._candidates = 1
        for frame in (view.frame for view in problem.views) if self.reach.candidates > 1 else ():
            background = constant(problem.bounds.background, frame.rgb)
            plain = ((frame.rgb - background).abs() <= DIFFERENT).all(-1)
            plain = plain if frame.depth is None else plain & (frame.depth <= 0)
            plain = plain if frame.hidden is None else plain[~frame.hidden]
            if float(plain.float().mean()) > 0.02:
                self._candidates = self.reach.candidates

    def __call__(self, T_world_last: SE3) -> Float[Tensor, ""]:
        """Return the loss, differentiable in the pose of the last view's camera."""
        problem, generator, here = self.problem, self.generator, T_world_last.detach()
        many, device = self.rays.rays * self._candidates, problem.device
        pixels = draw(problem.views, many, DRAWERS[self.rays.pixels], generator, device=device)
        if self._candidates > 1:
            count = max(1, self.rays.rays // len(problem.views))
            # The rank is 2 or more for pixels that show matter in the image, and 1 for others whose rays may hit it in the map.
            background = constant(self._bounds.background, pixels.rgb)
            shows = pixels.measured | ((pixels.rgb - background).abs().amax(-1) > DIFFERENT)
            rank = 2 * shows.int() + self._field.sampler(self._rays(pixels, here)).valid.any(-1).int()
            best = rank.sort(dim=-1, descending=True, stable=True).indices[:, :count]
            parts = (
                part.take_along_dim(best if part.ndim == 2 else best[..., None], 1) for part in vars(pixels).values()
            )
            pixels = Observations(*parts)
        found = self._loss(pixels, T_world_last)
        if problem.depth_rays is not None and self.objective.uses_depth and self.depth_rays > 0:
            others = problem.depth_rays.drawn(self.depth_rays, generator, device=device)[None]
            found = found + self._loss(others, T_world_last)
        return found

    def _loss(self, observed: Observations, T_world_last: SE3) -> Float[Tensor, ""]:
        """Return the objective's loss plus the weighted mean robust distance (metres) between measured points and the box of the scene."""
        bounds, weight, rays = self._bounds, self.reach.box_weight, self._rays(observed, T_world_last)
        loss = self.objective.loss(render(self._field, rays, bounds.background), observed)
        if weight == 0 or not self.objective.uses_depth or bounds.contracted:
            return loss
        points = rays.origins + observed.distance[..., None] * rays.directions
        beyond = (points - constant(bounds.centre, points)).abs() - constant(bounds.size, points) / 2
        robust = Robust("huber", rendered_depth_scale(bounds))
        outside = robust(torch.linalg.vector_norm(beyond.clamp(min=0), dim=-1))
        return loss + weight * masked_mean(outside, observed.measured).mean()

    def _rays(self, observed: Observations, T_world_last: SE3) -> Rays:
        rays = observed.rays(T_world_last, self._bounds)
        return rays if self.rays.wide == 1 else widen(rays, self.rays.wide)
