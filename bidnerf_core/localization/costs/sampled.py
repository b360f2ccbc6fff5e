"""The loss of a pose on sampled rays (eq. 6), for first-order solvers."""

from __future__ import annotations

from dataclasses import dataclass, field

from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.field import widened
from bidnerf_core.localization.costs.weighted_rays import RayCounts
from bidnerf_core.localization.problem import Problem
from bidnerf_core.observations import Observations
from bidnerf_core.pixels import DrawerName, PixelDrawer, draw, drawer
from bidnerf_core.rendering import render
from bidnerf_core.residuals import Objective
from bidnerf_core.se3 import SE3


@dataclass(eq=False)
class SampledLoss:
    """The loss at a pose, on pixels that are drawn anew at each call or once for all."""

    problem: Problem
    objective: Objective
    counts: RayCounts
    pixels: DrawerName
    renew: bool  # whether pixels are drawn anew
    level: int | None
    wide: float  # length of the sampled interval over [near, far]
    generator: Generator
    _drawer: PixelDrawer = field(init=False)
    _batches: list[Observations] | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._drawer = drawer(self.pixels)

    def __call__(self, T_world_last: SE3) -> Float[Tensor, ""]:
        """Return the loss; differentiable in the pose of the last view's camera."""
        if self._batches is None or self.renew:
            self._batches = self._drawn()
        first, *others = (self._loss(batch, T_world_last) for batch in self._batches)
        return sum(others, start=first)

    def _loss(self, observed: Observations, T_world_last: SE3) -> Float[Tensor, ""]:
        bounds = self.problem.bounds
        rays = observed.rays(T_world_last, bounds)
        rays = rays if self.wide == 1 else widened(rays, self.wide)
        return self.objective.loss(render(self.problem.level(self.level), rays, bounds.background), observed)

    def _drawn(self) -> list[Observations]:
        """Draw pixels (views, pixels a view) and, where there are any, rays of depth (1, rays)."""
        problem, device = self.problem, self.problem.device
        batches = [draw(problem.views, self.counts.pixels, self._drawer, self.generator, device=device)]
        if problem.depth_rays is not None and self.objective.uses_depth and self.counts.depth_rays > 0:
            batches.append(
                problem.depth_rays.drawn(self.counts.depth_rays, self.generator, device=device)[None]
            )
        return batches
