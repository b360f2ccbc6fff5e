"""Method ``bid``: colour and depth of one or several images, at the coarse level (BID-NeRF, Alg. 1)."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.localization.first_order import PAPERS_REACH, descended
from bidnerf_core.localization.method_settings import (
    AdamSettings,
    ColourSettings,
    DepthSettings,
    DescentSettings,
    ReachSettings,
    objective_of,
)
from bidnerf_core.localization.methods import Method
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.settings import Settings

WIDE_REACH = ReachSettings(candidates=3, box_weight=1.0)
"""Pixels on matter and measured points in the box of the scene. On Lego this helped most (``benchmarks/bid_variants.py``)."""


@dataclass(frozen=True)
class BidConfig(Settings):
    """Settings of method ``bid``."""

    # The camera's own frame is the paper's pivot.
    descent: DescentSettings = DescentSettings(level=0, pivot="scene")
    adam: AdamSettings = AdamSettings(learning_rate=0.04, decay=0.4, decay_steps=80)
    colour: ColourSettings = ColourSettings()
    depth: DepthSettings = DepthSettings()
    reach: ReachSettings = WIDE_REACH


PAPER_STEPS = AdamSettings(max_steps=1000, learning_rate=0.02, decay=0.8, decay_steps=100)
"""The paper's number of steps, with iNeRF's decay. The paper does not give its learning rate; this one is provisional."""

BID_PRESETS = {
    "paper": BidConfig(DescentSettings(level=0, pivot="camera"), PAPER_STEPS, reach=PAPERS_REACH),
    "paper-scene": BidConfig(DescentSettings(level=0, pivot="scene"), PAPER_STEPS, reach=PAPERS_REACH),
}
"""The paper's settings with updates as in its Alg. 1, in the camera's frame, and with ours, about the middle of the scene."""


def bid(problem: Problem, config: BidConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start``; pixels are drawn from ``seed``."""
    objective = objective_of(config.colour, config.depth)
    depth_rays = config.depth.depth_rays
    return descended(problem, config.descent, config.adam, objective, depth_rays, seed, "bid", config.reach)


BID = Method(
    bid,
    BidConfig,
    needs_start=True,
    presets=BID_PRESETS,
    summary="Adam on colour and depth at the coarse level (BID-NeRF)",
)
