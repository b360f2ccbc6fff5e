"""The solvers of ``bid`` and ``inerf``, their presets, and the methods that entry points name."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import torch
from torch import Generator

from bidnerf_bid.adam import follow_gradient, recent_loss
from bidnerf_bid.pivot import middle_of_view, pivot
from bidnerf_bid.sampled import SampledLoss
from bidnerf_bid.settings import (
    AdamSettings,
    BidConfig,
    DepthSettings,
    DescentSettings,
    InerfConfig,
    ReachSettings,
    objective_of,
)
from bidnerf_core.devices import move_to
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import (
    DepthLossSettings,
    Localization,
    Method,
    Problem,
    Support,
    draw_rays,
    rendered_depth_scale,
    states_at,
    support,
)

RAYS = 1024
"""Number of rays by which the pose that a first-order method found is judged."""


def bid(problem: Problem, config: BidConfig, seed: int = 0) -> Localization:
    """Refine ``problem.start`` with Adam on colour and depth; pixels are drawn with ``seed``. Raises ``InputError`` without a start."""
    return descend_from_start(problem, config, config.depth, config.reach, seed, "bid")


def inerf(problem: Problem, config: InerfConfig, seed: int = 0) -> Localization:
    """Refine ``problem.start`` with Adam on colour alone. Raises ``InputError`` for more than one image, or without a start."""
    if len(problem.views) > 1:
        raise InputError(f"method inerf takes one image, got {len(problem.views)}; method bid takes several")
    return descend_from_start(problem, config, None, ReachSettings(), seed, "inerf")


def descend_from_start(
    problem: Problem,
    config: BidConfig | InerfConfig,
    depth: DepthSettings | None,
    reach: ReachSettings,
    seed: int,
    method: str,
) -> Localization:
    """Descend with Adam from ``problem.start`` (Alg. 1), then accept or reject the pose.

    Low-contrast images have a small loss even at a wrong pose, so newly drawn rays must also support the pose.
    """
    began, start, device = time.perf_counter(), problem.start, problem.device
    if start is None:
        raise InputError(f"method {method!r} needs a start; give one, or use a method that needs none")
    if depth is not None and depth.depth_scale is None:
        depth = replace(depth, depth_scale=rendered_depth_scale(problem.bounds))
    objective, generator = objective_of(config.colour, depth), Generator(device).manual_seed(seed)
    own = 0 if depth is None else depth.depth_rays
    loss = SampledLoss(move_to(problem, device), objective, own, config.descent, reach, generator)
    about = pivot(config.descent.pivot, problem)
    poses, losses, finite, ending = follow_gradient(loss, about, config.adam, start, device, generator)
    T, mean = poses[-1], recent_loss(losses)
    # How well rays that were not used distinguish the pose from its rivals.
    by_depth = None if depth is None else DepthLossSettings(depth.depth_weight, depth.depth_loss, depth.depth_scale)
    rays = draw_rays(problem, config.colour, by_depth, RAYS, seed, config.descent.level_of(problem.field))
    rays = replace(rays, exposure=False)
    middle = middle_of_view(problem, T if bool(T.matrix().isfinite().all()) else None)
    measures = support(lambda T: rays.costs(states_at(T)), T, middle, rays.plain_costs())
    most = config.adam.converged_loss
    is_finite = float(finite and math.isfinite(mean))
    found = Support(measures | {"finite": is_finite, "mean_loss": mean}, {"mean_loss": most})
    verdict = found.verdict(f"mean loss {mean:.3g}, must be below {most:.3g}")
    verdict = replace(verdict, reason=f"{ending}; {verdict.reason}")
    return Localization.of(
        verdict, SE3.stack(poses), torch.tensor(losses, dtype=torch.float64), method, began, mean, None, found
    )


PAPER = BidConfig(
    DescentSettings(level=0, pivot="camera"),
    AdamSettings(max_steps=1000, learning_rate=0.02, decay=0.8, decay_steps=100),
    depth=DepthSettings(depth_scale=0.1),
    reach=ReachSettings(),
)
"""The paper's settings, with updates in the camera's frame as in its Alg. 1, and iNeRF's decay.

The paper does not give its learning rate; this one is provisional.
"""
BID = Method(
    bid,
    BidConfig,
    needs_start=True,
    presets={"paper": PAPER, "paper-scene": replace(PAPER, descent=DescentSettings(level=0, pivot="scene"))},
    summary="Adam on colour and depth at the coarse level (BID-NeRF)",
)
INERF = Method(
    inerf,
    InerfConfig,
    needs_start=True,
    uses_depth=False,
    # The settings of BID-NeRF's comparison: iNeRF's own learning rate, and 1000 steps of 2048 rays.
    presets={"paper": InerfConfig(adam=AdamSettings(max_steps=1000, learning_rate=0.01))},
    summary="Adam on the colours of one image in full detail (iNeRF)",
)
