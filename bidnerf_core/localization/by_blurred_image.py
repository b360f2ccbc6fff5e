"""Poses of blurred images, by comparing whole images with renderings of the same blur.

Keypoints are inaccurate in blurred images. Rendered rays are as sharp as the field, so the edges, which constrain the pose most,
become outliers. A rendering blurred like the image has the same edges.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import moved
from bidnerf_core.geometry import SE3, USUAL
from bidnerf_core.localization.acceptance import may_be_miscalibrated
from bidnerf_core.localization.by_landmarks import is_sharp
from bidnerf_core.localization.confidence import TRUSTED
from bidnerf_core.localization.costs.images import (
    ColourScales,
    FieldRenderer,
    ImageCost,
    plain_pixel_costs,
    render_view,
    thumbnail,
)
from bidnerf_core.localization.covariance import LEAST_VARIANCE, position_deviation
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.solvers.levenberg_marquardt import Descent, descend
from bidnerf_core.localization.solvers.pivots import Pivot, pivot
from bidnerf_core.localization.support import Support, support

WIDTH = 100
"""Longer side of the compared images, pixels."""
BLURS = (0.0, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6)
"""Standard deviations of the blur that are tried, in pixels of these images."""
NOTICEABLE_BLUR = 0.7
"""The smallest of them for a blurred image. Even a sharp image is averaged over its pixels, unlike single rays."""
CLEARLY_LESS = 0.85
"""Ratio of the cost with the best blur to that without, below which an image counts as blurred."""
ROUNDS, STEPS = 3, 4
"""Number of estimates of the blur, and number of steps after each."""
HALF_AN_INLIER = 0.1
"""Norm of the colour difference at which a pixel's inlier weight is one half."""
LEAST_EXPLAINED_BLURRED = 0.75
"""Minimum fraction of the image's contrast that an accepted pose explains."""
PRECISE = 0.01
"""Maximum standard deviation of an accepted position, relative to the distance to the scene."""
UNSUITABLE = (
    Outcome.AMBIGUOUS, Outcome.DIVERGED, Outcome.MIRRORED, Outcome.MISCALIBRATED, Outcome.TOO_FEW_MATCHES
)  # fmt: skip
"""Outcomes of poses that a closer comparison cannot correct."""


def refined_if_blurred(problem: Problem, found: Localization) -> Localization:
    """Refine a doubtful pose and check it again if the images are blurrier than the field's renderings there.

    The pose is returned unchanged if depth was measured, part of an image is hidden, the intrinsics were corrected, are
    approximate or differ slightly from those of the map's images, the field itself is not sharp, or the map has no surface.
    """
    if not _is_eligible(problem, found):
        return found
    began = time.perf_counter()
    start = found.T_world_camera.to(problem.device)
    about = pivot("scene", replace(problem, start=found.T_world_camera)).to(problem.device)
    sharp = _cost(problem, about)
    costs = sharp.costs_of_blurs(start, BLURS).tolist()
    best = min(range(len(BLURS)), key=costs.__getitem__)
    if BLURS[best] < NOTICEABLE_BLUR or not costs[best] < CLEARLY_LESS * costs[0]:
        return found
    plain = plain_pixel_costs(sharp.thumbnails, HALF_AN_INLIER).double()
    if not bool(plain.any()):
        return found  # an image with a single colour, which any pose explains
    done = _descents(replace(sharp, blur=BLURS[best]), start, about)
    cost_at_end = float(done[-1].equations.cost[0])
    if not math.isfinite(cost_at_end):
        return found
    T = done[-1].T[0].to("cpu").normalized()
    covariance = about.to(torch.device("cpu")).at_camera(T, _covariance(done[-1], len(problem.views)))
    seen = render_view(sharp.renderer, sharp.thumbnails[-1], done[-1].T)
    precision = position_deviation(covariance) / float(seen.depth.median())
    blurred = sharp.with_blur_of(done[-1].T, BLURS)
    middle = seen.points[0].median(0).values.to("cpu", torch.float64)
    apart = support(blurred.pixel_costs, done[-1].T[0], middle, plain)
    verdict = _verdict(apart, precision)
    return replace(
        found,
        T_world_camera=T,
        outcome=verdict.outcome,
        reason=verdict.reason,
        confidence=verdict.confidence,
        diagnostics=apart,
        covariance=covariance if bool(covariance.isfinite().all()) else None,
        loss=cost_at_end,
        steps=found.steps + ROUNDS * STEPS,
        seconds=found.seconds + time.perf_counter() - began,
        poses=SE3.cat([found.poses, *(d.poses[1:, 0].to("cpu") for d in done)]),
        losses=torch.cat([found.losses, *(d.costs[:-1, 0].cpu() for d in done)]),
    )


def _is_eligible(problem: Problem, found: Localization) -> bool:
    """Return whether a pose is doubtful and whole images with the given intrinsics can be compared with renderings."""
    hidden = any(view.frame.hidden is not None for view in problem.views)
    unsuited_map = problem.surface is None or not is_sharp(problem)
    if problem.has_depth or hidden or unsuited_map or found.intrinsics is not None:
        return False
    # Support by sharp renderings does not mean that a blurred comparison would not be better.
    by_colour = isinstance(found.diagnostics, Support)
    doubtful = (by_colour or (found.confidence or 0.0) < TRUSTED) and found.outcome not in UNSUITABLE
    return doubtful and not may_be_miscalibrated(problem)


def _cost(problem: Problem, about: Pivot) -> ImageCost:
    """Return the cost of whole images against sharp renderings."""
    renderer = FieldRenderer(problem.field, problem.bounds, problem.device)
    small = [moved(thumbnail(view, WIDTH), problem.device) for view in problem.views]
    assert about.T_camera_pivot is not None
    middle = about.T_camera_pivot.translation.to(small[0].rgb)
    return ImageCost(renderer, small, ColourScales(colour=HALF_AN_INLIER), middle)


def _descents(cost: ImageCost, T: SE3, about: Pivot) -> list[Descent]:
    """Take the steps of all rounds, each with the best blur at its first pose; ``cost`` has that of the first round."""
    found = [descend(cost, T[None], STEPS, about.moved, damping=1e-2)]
    for _ in range(ROUNDS - 1):
        T = found[-1].T[0]
        found.append(descend(cost.with_blur_of(T, BLURS), T[None], STEPS, about.moved, damping=1e-2))
    return found


def _covariance(done: Descent, views: int) -> Float[Tensor, "6 6"]:
    """Return the covariance of an update at the pivot; not finite if the images do not determine it."""
    variance = done.equations.cost[0].clamp(min=LEAST_VARIANCE) / (USUAL.blurred * views)
    return torch.linalg.inv_ex(done.equations.hessian[0] / variance).inverse.cpu()


def _verdict(found: Support, precision: float) -> Verdict:
    """Accept or reject a pose by its support and by its standard deviation relative to the distance to the scene."""
    share = f"{max(found.explained, 0):.0%} of the contrast of the blurred image agrees with renderings blurred to match"
    rejection = found.rejection(LEAST_EXPLAINED_BLURRED)
    if rejection is not None:
        return replace(
            rejection, reason=f"{rejection.reason}: only {share}, expected {LEAST_EXPLAINED_BLURRED:.0%}"
        )
    if not precision <= PRECISE:
        why = f"the image is blurred, so the position is uncertain by {precision:.1%} of the distance to the scene"
        return Verdict(Outcome.IMPRECISE, f"{why}, expected at most {PRECISE:.0%}")
    return Verdict(Outcome.CONVERGED, share, found.confidence)
