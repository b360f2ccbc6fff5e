"""A trial of a map's field: align the map's own images with it from the poses of these images.

Where the field errs, it moves the answers, and the rays of an image err together. The scatter of the answers shows how many
independent measurements they count as in this map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.fields.contract import RadianceField, SceneBounds
from bidnerf_core.frames.frame import View
from bidnerf_core.geometry.independent import Independent
from bidnerf_core.geometry.robust import chi_squared_quantile
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.covariance import LEAST_VARIANCE
from bidnerf_core.localization.fusion import drawn_rays
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.solvers.levenberg_marquardt import descend
from bidnerf_core.localization.solvers.pivots import pivot

MOST_TRIED, ENOUGH_TRIED = 16, 6
"""Largest number of images that are aligned, and least number from which scatter is estimated."""
RAYS = 2048
"""Number of rays for each."""
STEPS, SHORT = 6, 1e-5
"""Largest number of steps, and length of a step (metres and radians) below which they end."""
QUANTILE = 0.9
"""Quantile of the errors at which their model is fitted: it covers the tails, and one image of ten may have a wrong pose."""
FITTED = 3.0
"""How many times fewer measurements the rays of other images count as: the field was fitted to those of the map."""
COUNTS = (0.1, 1e4)
"""Range of the number of independent measurements."""

Answer = tuple[Float[Tensor, "6"], Float[Tensor, "6 6"]]
"""The right update from an image's own pose to that found, and its covariance if there were a single measurement."""


def tried(field: RadianceField, bounds: SceneBounds, views: Sequence[View]) -> Independent:
    """Return how many independent measurements images of a map count as; the table's defaults where too few were tried."""
    count = min(len(views), MOST_TRIED)
    if count < ENOUGH_TRIED:
        return Independent()
    chosen = [views[int((i + 0.5) * len(views) / count)] for i in range(count)]
    answers = [_aligned(_problem(field, bounds, view)) for view in chosen]
    return Independent(rays=_limit(_count(answers), RAYS) / FITTED)


def _problem(field: RadianceField, bounds: SceneBounds, view: View) -> Problem:
    start = view.T_ref_camera.to("cpu", torch.float64)
    return Problem(field, bounds, (replace(view, T_ref_camera=SE3.identity()),), start).without_depth()


def _aligned(problem: Problem) -> Answer:
    start = problem.start_for("a trial")
    cost = drawn_rays(problem, RAYS, pivot("scene", problem), Generator().manual_seed(0))
    found = descend(cost, start[None], STEPS, cost.pivot.moved, stop=SHORT)
    variance = cost.residuals(found.T).variance().clamp(min=LEAST_VARIANCE)
    information = found.equations.hessian[0] / variance
    covariance = cost.pivot.at_camera(found.T[0], torch.linalg.pinv(information, hermitian=True))
    return (start.inverse() @ found.T[0]).log(), covariance


def _count(answers: Sequence[Answer]) -> float:
    """Return the number of independent measurements with which the errors are as large as their covariances predict."""
    updates, covariances = (torch.stack(parts) for parts in zip(*answers, strict=True))
    squared = torch.einsum("ni,ni->n", updates, torch.linalg.solve(covariances, updates))
    low, high = COUNTS
    count = chi_squared_quantile(QUANTILE, 6) / max(float(squared.quantile(QUANTILE)), 1 / high)
    return min(max(count, low), high)


def _limit(count: float, drawn: int) -> float:
    """Return the number that ``count`` tends to with more drawn measurements than these, see ``Independent``."""
    return min(COUNTS[1], count * (drawn - 1) / max(drawn - count, 1.0))
