"""Drawn rays with the weights of their residuals, which are the same for every pose that is tried."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Generator, Tensor
from torch.nn.functional import avg_pool2d, interpolate

from bidnerf_core.fields.observations import Observations
from bidnerf_core.fields.residuals import Objective
from bidnerf_core.frames.frame import View
from bidnerf_core.frames.pixels import DrawerName, draw, drawer
from bidnerf_core.localization.problem import Problem


@dataclass(frozen=True)
class RayCounts:
    """The numbers of rays to draw."""

    pixels: int  # in all, shared out equally among the views
    depth_rays: int = 0  # in addition, from a sensor with rays of its own


@dataclass(frozen=True, eq=False)
class WeightedRays:
    """Measured rays in the last camera's frame, and how much each residual counts in the objective."""

    observed: Observations  # (n)
    weights: Float[Tensor, "n c"]  # 0 where nothing was measured

    @cached_property
    def channels(self) -> tuple[int, ...]:
        """The residuals that were measured along any ray."""
        used = (self.weights > 0).any(0).tolist()
        return tuple(channel for channel, is_used in enumerate(used) if is_used)


def draw_weighted_rays(
    problem: Problem,
    objective: Objective,
    counts: RayCounts,
    pixels: DrawerName,
    blur: int,
    generator: Generator,
) -> WeightedRays:
    """Draw pixels of all views and, where there are any, depth rays, weighted as in eqs. 5 and 6.

    Colours are averaged over squares of ``blur`` x ``blur`` pixels; 1 leaves them as they are.
    """
    views = [blurred(view, blur) for view in problem.views] if blur > 1 else problem.views
    seen = draw(views, counts.pixels, drawer(pixels), generator, device=problem.device)
    observed, weights = seen.flattened(), objective.weights(seen).flatten(0, 1)
    if problem.depth_rays is None or not objective.uses_depth or counts.depth_rays == 0:
        return WeightedRays(observed, weights)
    own = problem.depth_rays.drawn(counts.depth_rays, generator, device=problem.device)
    weights = torch.cat([weights, objective.weights(own[None]).flatten(0, 1)])
    return WeightedRays(Observations.joined([observed, own]), weights)


def blurred(view: View, size: int) -> View:
    """Return the view with colours averaged over squares of ``size`` pixels and interpolated in between; depth is unchanged."""
    frame = view.frame
    height, width = frame.rgb.shape[:2]
    size = min(size, height, width)
    small = avg_pool2d(frame.rgb.permute(2, 0, 1)[None], size, ceil_mode=True, count_include_pad=False)
    # Enlarged to whole squares, then cut to the image, so that squares stay where they were.
    covered = (small.shape[2] * size, small.shape[3] * size)
    smooth = interpolate(small, covered, mode="bilinear", align_corners=False)[..., :height, :width]
    return replace(view, frame=replace(frame, rgb=smooth[0].permute(1, 2, 0).contiguous()))
