"""The loss of a pose on sampled rays (eq. 6)."""

from __future__ import annotations

from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.field import Rays, widened
from bidnerf_core.interest import DrawerName, drawer
from bidnerf_core.localization.problem import Problem
from bidnerf_core.pixels import Pixels, draw
from bidnerf_core.rendering import render
from bidnerf_core.residuals import Objective
from bidnerf_core.se3 import SE3


class SampledLoss:
    """Calls give the objective at a pose, on pixels that are drawn anew at each call, or once for all."""

    def __init__(
        self, problem: Problem, objective: Objective, count: int, pixels: DrawerName, renew: bool,
        level: int | None, wide: float, generator: Generator,
    ) -> None:  # fmt: skip
        self._problem, self._objective, self._count = problem, objective, count
        self._drawer, self._renew, self._generator = drawer(pixels), renew, generator
        self._field, self._wide = problem.level(level), wide
        self._pixels: Pixels | None = None

    def __call__(self, T_world_last: SE3) -> Float[Tensor, ""]:
        """Differentiable in the pose of the last view's camera."""
        bounds, pixels = self._problem.bounds, self._drawn()
        rays = self._widened(pixels.rays(T_world_last, bounds))
        return self._objective(render(self._field, rays, bounds.background), pixels)

    def _drawn(self) -> Pixels:
        if self._pixels is None or self._renew:
            problem = self._problem
            self._pixels = draw(
                problem.views, self._count, self._drawer, self._generator, device=problem.device
            )
        return self._pixels

    def _widened(self, rays: Rays) -> Rays:
        return rays if self._wide == 1 else widened(rays, self._wide)
