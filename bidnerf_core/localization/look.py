"""Fixed rays, and how any pose is judged by what they see."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.field import RadianceField, Rays
from bidnerf_core.localization.centring import centred
from bidnerf_core.localization.linearization import linearize
from bidnerf_core.localization.normal_equations import Losses, Residuals, residuals
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.ray_batch import RayBatch, draw_batch
from bidnerf_core.localization.sampled import RayCounts
from bidnerf_core.localization.solvers.levenberg_marquardt import System
from bidnerf_core.localization.solvers.pivots import Pivot
from bidnerf_core.localization.stages import Refinement, Stage
from bidnerf_core.robust import Robust
from bidnerf_core.sampling import AroundDepth, Resampled
from bidnerf_core.se3 import SE3


@dataclass(frozen=True, eq=False)
class Look:
    """A problem as one stage sees it."""

    problem: Problem
    batch: RayBatch
    stage: Stage
    settings: Refinement
    about: Pivot

    def system(self, T: SE3) -> System:
        """Of poses (h)."""
        return self.residuals(T).system()

    def cost(self, T: SE3) -> Float[Tensor, "h"]:
        """The same as the system's, without the time that derivatives take."""
        return self.residuals(T, derivatives=False).system().cost

    def residuals(self, T: SE3, derivatives: bool = True) -> Residuals:
        heard = (self.batch.share > 0).any(0).tolist()
        channels = tuple(c for c in range(4) if heard[c] and derivatives)
        rays, background = self.batch.rays(T, self.problem.bounds), self.problem.bounds.background
        least, field = self.settings.least_weight, self._field(rays)
        found = linearize(
            field,
            rays,
            self.batch.distance,
            3 * self.stage.depth_scale,
            self.about.at(T),
            background,
            least,
            channels,
        )
        return residuals(found, self.batch, self._losses, self.settings.exposure, self.stage.play)

    def centred(self, T: SE3) -> SE3:
        """Poses (h), each shifted so that the middle of what is seen is that of what was measured."""
        level = self.problem.level(self.stage.level)
        return centred(level, self.batch, self.problem.bounds, T)

    def anew(self, generator: Generator) -> Look:
        """The same with rays of its own."""
        return look_at(self.problem, self.stage, self.settings, self.about, generator)

    @property
    def _losses(self) -> Losses:
        return Losses(
            Robust(self.settings.colour_loss, self.stage.colour_scale),
            Robust(self.settings.depth_loss, self.stage.depth_scale),
        )

    def _field(self, rays: Rays) -> RadianceField:
        """The stage's level; sampled about the measured depth only, where the stage says so."""
        field = self.problem.level(self.stage.level)
        if self.stage.window == 0:
            return field
        distance = self.batch.distance.expand(rays.near.shape).flatten()
        count = self.settings.window_samples
        return Resampled(field, AroundDepth(distance, self.stage.window, count, field.sampler))


def look_at(problem: Problem, stage: Stage, settings: Refinement, about: Pivot, generator: Generator) -> Look:
    """Draw a stage's rays."""
    counts = RayCounts(stage.rays, settings.depth_rays)
    batch = draw_batch(problem, counts, settings.pixels, settings.depth_weight, stage.blur, generator)
    return Look(problem, batch, stage, settings, about)
