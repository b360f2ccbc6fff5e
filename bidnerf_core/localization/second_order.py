"""What ``bid-lm`` is settings of: many poses about the start, few of them refined, one answered with."""

from __future__ import annotations

import time
from dataclasses import dataclass

from torch import Generator

from bidnerf_core.localization.neighbours import neighbours
from bidnerf_core.localization.photometric import Refined, refine
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.settings import Judged
from bidnerf_core.localization.solvers.pivots import PivotName
from bidnerf_core.localization.stages import Refinement, Stage
from bidnerf_core.pixels import DrawerName
from bidnerf_core.robust import RobustName


@dataclass(frozen=True)
class SecondOrderConfig(Judged):
    """Settings of steps on colour, with depth or without."""

    poses: int = 32  # looked at first: the start, and others about it; 1: the start alone
    spread_translation: float = 0.3  # their standard deviation along each axis of the camera, metres
    spread_rotation: float = 0.12  # and about each, radians
    search_rays: int = 128  # for each of them
    coarse_poses: int = 6  # the best of these, which take steps at the coarsest level
    coarse_steps: int = 4
    coarse_rays: int = 128  # for each of them
    middle_poses: int = 2  # the best of these, which take more
    middle_steps: int = 4
    middle_rays: int = 256
    fine_steps: int = 6  # of the best one, in full detail
    fine_rays: int = 1024
    blur: int = 8  # observed colours of coarse steps are means over so many pixels each way
    pixels: DrawerName = "uniform"  # where pixels are drawn: anywhere, at corners, around corners
    pivot: PivotName = "scene"  # what an update turns about: the middle of what is seen, camera, world
    colour_loss: RobustName = "huber"  # robust loss of colour differences
    colour_scale: float = 0.1  # of it, in differences of colour: about where an outlier begins
    play: float = 0.03  # metres that surfaces may be off at coarse steps, a third of it at fine ones
    exposure: bool = False  # estimate a gain and a bias of each colour along
    least_weight: float = 0.01  # samples of less rendering weight have no part in derivatives
    stop_step: float = 1e-4  # a stage ends once a step is shorter than this (metres, radians)
    converged_inliers: float = 0.93  # share of fresh rays that must see what was measured ...
    converged_step: float = 0.02  # ... and longest step that they may ask for (metres, radians)

    def __post_init__(self) -> None:
        for name in ("poses", "coarse_poses", "middle_poses"):
            self._require(name, 1 <= getattr(self, name) <= 10**5, "1 to 100 thousand")
        for name in ("search_rays", "coarse_rays", "middle_rays", "fine_rays"):
            self._require(name, 7 <= getattr(self, name) <= 10**7, "7 to 10 million")
        for name in ("coarse_steps", "middle_steps", "fine_steps"):
            self._require(name, 1 <= getattr(self, name) <= 10**5, "1 to 100 thousand")
        self._require("blur", 1 <= self.blur <= 10**4, "1 to 10 thousand pixels")
        self._require("colour_scale", 0 < self.colour_scale <= 1e6, "a positive number, at most 1e+06")
        self._require("least_weight", 0 <= self.least_weight < 1, "a number from 0 to less than 1")
        self._require_one_of(pixels=DrawerName, pivot=PivotName, colour_loss=RobustName)
        for name in ("spread_translation", "spread_rotation", "play", "stop_step", "converged_inliers"):
            self._require_not_negative(name)
        self._require_not_negative("converged_step")


@dataclass(frozen=True)
class Depth:
    """How measured depth is used."""

    scale: float = 0.1  # metres: about where an outlier begins
    centring: int = 0  # shifts of each pose before the poses are put in order
    window: float = 0.0  # of the last stage


def stages(config: SecondOrderConfig, depth: Depth) -> tuple[Stage, ...]:
    """From many poses and few rays at the coarsest level to one pose and many rays in full detail."""
    c, scales = config, (config.colour_scale, depth.scale)
    wide = (3 * c.colour_scale, 3 * depth.scale)
    return (
        Stage(0, c.search_rays, c.poses, 0, c.blur, *wide, centring=depth.centring),
        Stage(c.coarse_steps, c.coarse_rays, c.coarse_poses, 0, c.blur, *scales, c.play),
        Stage(c.middle_steps, c.middle_rays, c.middle_poses, 0, c.blur, *scales, c.play),
        Stage(c.fine_steps, c.fine_rays, 1, None, 1, *scales, c.play / 3, depth.window),
    )


def second_order(
    problem: Problem, config: SecondOrderConfig, depth: Depth, settings: Refinement, seed: int, method: str
) -> Localization:
    """From ``problem.start`` through all stages."""
    began = time.perf_counter()
    start = neighbours(
        problem.start_for(method), config.poses, config.spread_translation, config.spread_rotation, seed
    )
    found = refine(problem, start, stages(config, depth), settings, Generator().manual_seed(seed))
    converged, reason = verdict(found, config)
    return Localization(
        T_world_camera=found.T,
        converged=converged,
        reason=reason,
        steps=len(found.losses),
        seconds=time.perf_counter() - began,
        loss=found.loss,
        method=method,
        poses=found.poses,
        losses=found.losses,
        covariance=found.covariance if bool(found.covariance.isfinite().all()) else None,
    )


def verdict(found: Refined, config: SecondOrderConfig) -> tuple[bool, str]:
    """Whether fresh rays see what was measured, and ask for no farther step."""
    if not bool(found.covariance.isfinite().all()):
        return False, "what was measured does not determine the pose"
    if not found.inliers >= config.converged_inliers:
        least = config.converged_inliers
        return False, f"{found.inliers:.0%} of fresh rays see what was measured, expected {least:.0%}"
    if not found.step <= config.converged_step:
        return (
            False,
            f"fresh rays ask for a step of {found.step:.3g}, expected {config.converged_step:g} at most",
        )
    return True, f"{found.inliers:.0%} of fresh rays see what was measured"
