"""Evidence for one of two explanations of an image: what the field renders from the pose that suits each best.

Keypoints are few and in a few places. Moving the camera nearly compensates for a wrong focal length, and symmetric things
resemble their mirror images, so keypoints hardly distinguish them. Thousands of rendered rays, which cover the whole image,
distinguish them better.
"""

from __future__ import annotations

from dataclasses import replace

from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.localization.beyond_chance import log_odds
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import take_few_steps
from bidnerf_core.localization.settings import ColourSettings, RefinementSettings, RefinementStage
from bidnerf_core.localization.solvers.pivots import pivot

COMPARED_RAYS = 8192
"""Number of rays on which two explanations are compared; fewer if fewer pixels are not hidden."""
FITTED = RefinementStage(steps=2, rays=1024)
"""The steps to the pose that suits an explanation best. The comparison draws other rays."""
NOISIEST = 0.15
"""Colour noise of a field on its own training images above which it provides no evidence: it has hardly been trained."""


def log_odds_by_rendering(one: Problem, other: Problem, seed: int, steps: int = FITTED.steps) -> float:
    """Return the log odds, by rendered colours alone, of ``one`` against ``other``.

    Both hold images of the same size with intrinsics and, as the start, the pose found with them; ``steps`` steps lead from
    there to the pose that suits them best. Returns 0 where the field is too noisy or renders values that are not finite.
    """
    if one.colour_noise is not None and one.colour_noise > NOISIEST:
        return 0.0
    stage = replace(FITTED, steps=steps)
    rival = _ray_costs(other, stage, seed)
    return float(log_odds(rival[None], _ray_costs(one, stage, seed))[0])


def _ray_costs(problem: Problem, stage: RefinementStage, seed: int) -> Float[Tensor, "n"]:
    """Return the cost of each ray from the pose near the start that suits the images best."""
    problem = problem.without_depth()
    assert problem.start is not None
    settings = RenderedCostSettings(ColourSettings(), None, RefinementSettings(exposure=True))
    generator = Generator().manual_seed(seed)
    T = take_few_steps(problem, problem.start, stage, settings, generator).poses[-1]
    compared = replace(stage, rays=min(COMPARED_RAYS, _visible_pixels(problem)))
    cost = settings.drawn(
        problem.on_device(), compared, pivot("scene", problem).to(problem.device), generator
    )
    return cost.residuals(T[None], derivatives=False).ray_costs()[0]


def _visible_pixels(problem: Problem) -> int:
    sizes = [view.frame.intrinsics.width * view.frame.intrinsics.height for view in problem.views]
    hidden = [0 if view.frame.hidden is None else int(view.frame.hidden.sum()) for view in problem.views]
    return max(1, sum(sizes) - sum(hidden))
