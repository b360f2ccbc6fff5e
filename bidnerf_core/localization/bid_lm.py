"""Method ``bid-lm``: colour and depth of one or several images, by second-order steps from coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.second_order import Depth, SecondOrderConfig, second_order
from bidnerf_core.localization.stages import Refinement
from bidnerf_core.robust import RobustName


@dataclass(frozen=True)
class BidLmConfig(SecondOrderConfig):
    """Settings of method ``bid-lm``."""

    depth_weight: float = 3.0  # lambda_d
    depth_loss: RobustName = "huber"  # robust loss of depth differences
    depth_scale: float = 0.1  # of it, in metres: about where an outlier begins
    depth_rays: int = 256  # besides, of a sensor with rays of its own, where there is one
    centring: int = 2  # times that what a pose sees is shifted to the middle of what was measured
    depth_window: float = 0.0  # metres about the measured depth that fine steps look at; 0: the whole ray
    window_samples: int = 12  # within it

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("depth_scale", 0 < self.depth_scale <= 1e6, "a positive number, at most 1e+06")
        self._require("depth_rays", 0 <= self.depth_rays <= 10**7, "0 to 10 million")
        self._require("centring", 0 <= self.centring <= 100, "0 to 100 times")
        self._require("window_samples", 1 <= self.window_samples <= 10**4, "1 to 10 thousand")
        self._require_one_of(depth_loss=RobustName)
        for name in ("depth_weight", "depth_window"):
            self._require_not_negative(name)


def bid_lm(problem: Problem, config: BidLmConfig, seed: int = 0) -> Localization:
    """From ``problem.start``; poses about it and pixels are drawn from ``seed``."""
    settings = Refinement(
        config.depth_weight, config.colour_loss, config.depth_loss, config.pixels, config.pivot, config.exposure,
        config.depth_rays, config.least_weight, config.window_samples, config.stop_step,
    )  # fmt: skip
    depth = Depth(config.depth_scale, config.centring, config.depth_window)
    return second_order(problem, config, depth, settings, seed, "bid-lm")
