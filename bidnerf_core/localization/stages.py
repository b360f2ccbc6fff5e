"""What a refinement from coarse to fine is made of, as settings."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.localization.solvers.pivots import PivotName
from bidnerf_core.pixels import DrawerName
from bidnerf_core.robust import RobustName


@dataclass(frozen=True)
class Stage:
    """So many steps at one level of detail, on one draw of rays; without any, poses are only put in order.

    ``centring`` comes before.
    """

    steps: int
    rays: int  # for each pose
    keep: int = 1  # poses that it begins with: the best so far
    level: int | None = None  # of the field: 0 is the coarsest; none is the field itself, in full detail
    blur: int = 1  # observed colours are means over so many pixels each way
    colour_scale: float = 0.1  # differences of colour: about where an outlier begins
    depth_scale: float = 0.1  # the same of distance, metres
    play: float = 0.0  # metres that surfaces may be off: steep measurements count for the less
    window: float = 0.0  # metres about the measured depth that are looked at; 0: the whole ray
    damping: float = 1e-3  # at first
    centring: int = (
        0  # times that each pose is shifted to bring what it sees to the middle of what was measured
    )


@dataclass(frozen=True)
class Refinement:
    """Settings that all stages share."""

    depth_weight: float = 1.0  # lambda_d
    colour_loss: RobustName = "huber"
    depth_loss: RobustName = "huber"
    pixels: DrawerName = "uniform"
    pivot: PivotName = "scene"
    exposure: bool = False  # estimate a gain and a bias of each colour along
    depth_rays: int = 512  # besides, of a sensor with rays of its own
    least_weight: float = 0.01  # samples of less count for what is seen, not for how it changes
    window_samples: int = 12  # within the window of a stage that has one
    stop_step: float = 1e-4  # a stage ends at a step shorter than this (metres, radians)
