"""The loss of a pose on sampled rays (eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.field import Rays, widened
from bidnerf_core.localization.problem import Problem
from bidnerf_core.observations import Observations
from bidnerf_core.pixels import DrawerName, draw, drawer
from bidnerf_core.rendering import Rendering, render
from bidnerf_core.residuals import Objective
from bidnerf_core.se3 import SE3


@dataclass(frozen=True)
class RayCounts:
    """How many rays a batch has."""

    pixels: int  # in all, shared out equally among the views
    depth_rays: int = 0  # besides, where there are any


class SampledLoss:
    """Calls give the objective at a pose, on pixels that are drawn anew at each call, or once for all."""

    def __init__(
        self, problem: Problem, objective: Objective, rays: RayCounts, pixels: DrawerName, renew: bool,
        level: int | None, wide: float, generator: Generator,
    ) -> None:  # fmt: skip
        self._problem, self._objective, self._counts = problem, objective, rays
        self._drawer, self._renew, self._generator = drawer(pixels), renew, generator
        self._field, self._wide = problem.level(level), wide
        self._batch: tuple[Observations, Observations | None] | None = None

    def __call__(self, T_world_last: SE3) -> Float[Tensor, ""]:
        """Differentiable in the pose of the last view's camera."""
        if self._batch is None or self._renew:
            self._batch = self._drawn()
        pixels, depth_rays = self._batch
        loss = self._objective(self._seen(pixels, T_world_last), pixels)
        if depth_rays is not None:
            loss = loss + self._objective.on_depth_rays(self._seen(depth_rays, T_world_last), depth_rays)
        return loss

    def _seen(self, what: Observations, T_world_last: SE3) -> Rendering:
        bounds = self._problem.bounds
        return render(self._field, self._widened(what.rays(T_world_last, bounds)), bounds.background)

    def _drawn(self) -> tuple[Observations, Observations | None]:
        problem, chance = self._problem, self._generator
        pixels = draw(problem.views, self._counts.pixels, self._drawer, chance, device=problem.device)
        if problem.depth_rays is None or not self._objective.heeds_depth or self._counts.depth_rays == 0:
            return pixels, None
        return pixels, problem.depth_rays.drawn(self._counts.depth_rays, chance, device=problem.device)

    def _widened(self, rays: Rays) -> Rays:
        return rays if self._wide == 1 else widened(rays, self._wide)
