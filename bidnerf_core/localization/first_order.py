"""First-order methods: Adam on the loss of sampled rays, with the configurations ``bid`` and ``inerf``.

``bid`` uses colour and depth of one or several images at the coarse level (BID-NeRF, Alg. 1), and ``inerf`` the colours of one
image in full detail (Yen-Chen et al. 2021, iNeRF). "In full detail" means the field itself, which a NeRF renders hierarchically
with its coarse and fine networks. iNeRF optimizes the magnitude and axis of one screw motion from the start; here, each step is
a separate update in the same frame, the world's. The two differ to second order, and updates have no axis that is undefined at
magnitude 0.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.fields import Objective
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.acceptance import DescentDiagnostics, descent_verdict
from bidnerf_core.localization.beyond_chance import Support
from bidnerf_core.localization.costs.rendered import RayCounts, RenderedCost, draw_weighted_rays
from bidnerf_core.localization.costs.sampled import SampledLoss
from bidnerf_core.localization.methods import Method
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import rendered_support
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.settings import (
    AdamSettings,
    ColourSettings,
    DepthSettings,
    DescentSettings,
    ReachSettings,
    RefinementSettings,
    RefinementStage,
    objective_of,
)
from bidnerf_core.localization.solvers.adam import follow_gradient
from bidnerf_core.localization.solvers.history import History
from bidnerf_core.localization.solvers.pivots import pivot
from bidnerf_core.settings import Settings

SUPPORTING_RAYS = 1024
"""Number of rays on which a pose is compared with its rivals."""
PAPER_STEPS = AdamSettings(max_steps=1000, learning_rate=0.02, decay=0.8, decay_steps=100)
"""The paper's number of steps, with iNeRF's decay. The paper does not give its learning rate; this one is provisional."""


def descended(
    problem: Problem, rays: DescentSettings, adam: AdamSettings, objective: Objective, depth_rays: int, seed: int,
    method: str, reach: ReachSettings,
) -> Localization:  # fmt: skip
    """Descend with Adam from ``problem.start`` (Alg. 1), then accept or reject the pose."""
    began = time.perf_counter()
    start, device = problem.start_for(method), problem.device
    generator = torch.Generator(device).manual_seed(seed)
    loss = SampledLoss(
        problem.on_device(), objective, RayCounts(rays.rays, depth_rays), rays, reach, generator
    )
    history = History([start])
    finite, reason = follow_gradient(
        loss, pivot(rays.pivot, problem), adam, history, device, generator if loss.is_capturable else None
    )
    T, mean = history.answer(adam.answer)
    found = _support(problem, rays, objective, depth_rays, T, seed)
    verdict = descent_verdict(mean, adam.converged_loss, finite, reason, found, 1 - adam.plain_share)
    return Localization(
        T_world_camera=T,
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=len(history.poses) - 1,
        seconds=time.perf_counter() - began,
        loss=mean,
        method=method,
        poses=SE3.stack(history.poses),
        losses=torch.tensor(history.losses, dtype=torch.float64),
        confidence=verdict.confidence,
        diagnostics=DescentDiagnostics(mean, adam.converged_loss, found),
    )


def _support(
    problem: Problem, rays: DescentSettings, objective: Objective, depth_rays: int, T: SE3, seed: int
) -> Support:
    """Return how well rays not used in the fit distinguish the pose from its rivals."""
    problem, about = problem.on_device(), pivot("camera", problem).to(problem.device)
    counts = RayCounts(SUPPORTING_RAYS, min(depth_rays, SUPPORTING_RAYS))
    drawn = draw_weighted_rays(problem, objective, counts, "uniform", 1, torch.Generator().manual_seed(seed))
    stage = RefinementStage(0, SUPPORTING_RAYS, level=rays.level)
    return rendered_support(RenderedCost(problem, drawn, objective, stage, RefinementSettings(), about), T)


@dataclass(frozen=True)
class BidConfig(Settings):
    """Settings of method ``bid``."""

    # The camera's own frame is the paper's pivot.
    descent: DescentSettings = DescentSettings(level=0, pivot="scene")
    adam: AdamSettings = AdamSettings(learning_rate=0.04, decay=0.4, decay_steps=80)
    colour: ColourSettings = ColourSettings()
    depth: DepthSettings = DepthSettings()
    # Favour pixels on matter, and keep measured points in the scene's box: the best variant on Lego (``benchmarks/bid_variants.py``).
    reach: ReachSettings = ReachSettings(candidates=3, box_weight=1.0)


def bid(problem: Problem, config: BidConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start``; pixels are drawn from ``seed``."""
    objective = objective_of(config.colour, config.depth)
    depth_rays = config.depth.depth_rays
    return descended(problem, config.descent, config.adam, objective, depth_rays, seed, "bid", config.reach)


BID = Method(
    bid,
    BidConfig,
    needs_start=True,
    # The paper's settings, with updates in the camera's frame as in its Alg. 1, and about the middle of the scene as by default.
    presets={
        "paper": BidConfig(DescentSettings(level=0, pivot="camera"), PAPER_STEPS, reach=ReachSettings()),
        "paper-scene": BidConfig(DescentSettings(level=0, pivot="scene"), PAPER_STEPS, reach=ReachSettings()),
    },
    summary="Adam on colour and depth at the coarse level (BID-NeRF)",
)


@dataclass(frozen=True)
class InerfConfig(Settings):
    """Settings of method ``inerf``: the learning rate and its decay are iNeRF's (section 4)."""

    descent: DescentSettings = DescentSettings(pixels="interest-regions", pivot="world")
    adam: AdamSettings = AdamSettings(max_steps=300)
    colour: ColourSettings = ColourSettings(colour_loss="l2")


def inerf(problem: Problem, config: InerfConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start`` on colour alone. Raises ``InputError`` for more than one image."""
    if len(problem.views) > 1:
        raise InputError(f"method inerf takes one image, got {len(problem.views)}; method bid takes several")
    objective = objective_of(config.colour, None)
    return descended(problem, config.descent, config.adam, objective, 0, seed, "inerf", ReachSettings())


INERF = Method(
    inerf,
    InerfConfig,
    needs_start=True,
    uses_depth=False,
    # The settings of BID-NeRF's comparison: iNeRF's own learning rate, and 1000 steps of 2048 rays.
    presets={"paper": replace(InerfConfig(), adam=AdamSettings(max_steps=1000))},
    summary="Adam on the colours of one image in full detail (iNeRF)",
)
