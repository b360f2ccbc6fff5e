"""Method ``auto``, whatever was measured: by depth where there is enough of it, by colour where there is not."""

from __future__ import annotations

from bidnerf_core.localization.auto import LEAST_POINTS, AutoConfig, auto
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.rgb_only import rgb_only


def by_depth_or_colour(problem: Problem, config: AutoConfig, seed: int = 0) -> Localization:
    """Depth on rays of its own, beside images that have none, is for a descent from a start, if there is a start.

    Raises ``InputError`` where a start is needed, for want of a baked surface, and there is none.
    """
    for_descent = problem.start is not None and problem.depth_rays is not None
    if problem.surface is None or for_descent or _measured(problem) >= LEAST_POINTS:
        return auto(problem, config, seed)
    return rgb_only(problem, problem.surface, config.hypotheses, config.rounds, seed)


def _measured(problem: Problem) -> int:
    """Pixels with depth."""
    images = [view.frame.depth for view in problem.views if view.frame.depth is not None]
    return sum(int(((depth > 0) & depth.isfinite()).sum()) for depth in images)
