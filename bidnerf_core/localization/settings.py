"""Settings of the methods and the tracker, in groups that methods share, and the objectives that these settings define."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from bidnerf_core.depth import DEPTH_SENSORS
from bidnerf_core.fields import (
    DEPTH_RESIDUALS,
    Objective,
    SceneBounds,
    colour_term,
    depth_term,
    free_space_term,
    opacity_term,
)
from bidnerf_core.frames import DrawerName
from bidnerf_core.geometry import Robust, RobustName
from bidnerf_core.localization.accept import least_confidence
from bidnerf_core.localization.problem import PivotName
from bidnerf_core.settings import EXPERT, Above, Count, NotNegative, OneOf, Positive, Range, Settings

LEAST_POINTS = 50
"""Minimum number of measured depths from which the shape of the scene can be recognised."""


@dataclass(frozen=True)
class ColourSettings(Settings):
    """Settings of the photometric term."""

    colour_loss: RobustName = "huber"  # robust loss of colour differences
    colour_scale: Positive = 0.1  # colour difference, in [0, 1], at which outliers begin


@dataclass(frozen=True)
class DepthLossSettings(Settings):
    """Settings of the depth term of second-order steps, which applies where depth was measured."""

    # weight of the depth term; the photometric term has weight 1, and differences are in units of their scales
    depth_weight: NotNegative = 4.0
    depth_loss: RobustName = "huber"  # robust loss of depth differences
    # depth difference, metres, at which outliers begin; None: 1.9 % of the scene's mean side, in first-order steps twice as much
    depth_scale: Positive | None = None


@dataclass(frozen=True)
class DepthSettings(DepthLossSettings):
    """Settings of the depth term of first-order steps, which applies where depth was measured."""

    # weight of the depth term, per square metre; the photometric term has weight 1
    depth_weight: NotNegative = 1.0
    depth_residual: Annotated[str, OneOf(DEPTH_RESIDUALS), EXPERT] = "distance"  # how depths are compared
    # number of rays drawn from a sensor with rays of its own
    depth_rays: Annotated[int, Range(0, 10**7), EXPERT] = 512
    # weight of the term that penalises matter in front of measured depth
    free_space_weight: Annotated[float, Range(0.0), EXPERT] = 0.0
    # weight of the term that penalises transparency where depth was measured
    opacity_weight: Annotated[float, Range(0.0), EXPERT] = 0.0


def objective_of(colour: ColourSettings, depth: DepthSettings | None) -> Objective:
    """Return the objective of first-order steps (eq. 5); the depth settings must have a ``depth_scale``."""
    terms = [colour_term(Robust(colour.colour_loss, colour.colour_scale))]
    if depth is not None and max(depth.depth_weight, depth.free_space_weight, depth.opacity_weight) > 0:
        assert depth.depth_scale is not None
        robust = Robust(depth.depth_loss, depth.depth_scale)
        terms.append(depth_term(robust, depth.depth_weight, DEPTH_RESIDUALS[depth.depth_residual]))
        if depth.free_space_weight > 0:
            terms.append(free_space_term(robust, depth.free_space_weight))
        if depth.opacity_weight > 0:
            terms.append(opacity_term(depth.opacity_weight))
    return Objective(tuple(terms))


@dataclass(frozen=True)
class DescentSettings(Settings):
    """Settings of the rays of a step and of the frame of updates."""

    rays: Count = 2048  # number of rays per step, divided equally among the views
    level: int | None = None  # level of the field: 0 is the coarsest, None the field itself
    pixels: DrawerName = "uniform"  # where pixels are drawn: anywhere, at corners, around corners
    pivot: PivotName = "camera"  # what an update rotates about: camera, world, or the middle of the scene
    # length of the sampled interval, in units of [near, far]; the paper's "wide" is 2
    wide: Annotated[float, Above(0.0, 100.0)] = 1.0


@dataclass(frozen=True)
class ReachSettings(Settings):
    """Settings that widen the basin of convergence of first-order steps. The defaults leave the paper's objective unchanged."""

    # number of pixels drawn for each ray, for images with background; pixels on matter are preferred, then those that may hit it
    candidates: Annotated[int, Range(1, 64), EXPERT] = 1
    # weight of the distance between measured points and the box of the scene, unless there is matter beyond the box
    box_weight: Annotated[float, Range(0.0), EXPERT] = 0.0


@dataclass(frozen=True)
class AdamSettings(Settings):
    """Settings of Adam's steps and of the criteria that end them."""

    max_steps: Count = 200  # maximum number of steps
    # initial length of a step, metres and radians; None: 1.25 % of the distance to the pivot
    learning_rate: Annotated[float, Above(0.0, 1e3)] | None = None
    decay: Annotated[float, Above(0.0, 1.0)] = 0.8  # factor by which the learning rate falls in decay_steps
    decay_steps: Count = 100  # number of steps in which the learning rate falls by decay
    # stop once the mean loss of 20 steps is below this (epsilon of Alg. 1); 0: never
    stop_loss: NotNegative = 0.0
    converged_loss: NotNegative = 0.02  # mean loss of 20 steps below which the answer counts as converged


@dataclass(frozen=True)
class RefinementSettings(Settings):
    """Settings of second-order steps on rendered rays from coarse to fine, and of their acceptance by newly drawn rays."""

    fine_steps: Annotated[int, Range(1, 10**5)] = 8  # steps of the best pose, in full detail
    # number of rays rendered for each of the fine steps, and of fractions of it before
    fine_rays: Annotated[int, Range(7, 10**7)] = 1024
    colour: ColourSettings = ColourSettings()
    converged_inliers: NotNegative = 0.93  # minimum inlier fraction of the rays for an accepted pose


def mean_side(bounds: SceneBounds) -> float:
    """Return the geometric mean of the sides of the scene's box, metres."""
    return math.prod(bounds.size) ** (1 / 3)


def rendered_depth_scale(bounds: SceneBounds) -> float:
    """Return the depth error (metres) beyond which a rendered ray counts as an outlier.

    A field's resolution, and hence the error of its depth, is a fraction of the size of the field's box, and so is this threshold: 3.8 % of
    the mean side. The resolution of a baked surface does not matter: it may come from measured depth, which is more accurate than the
    field's renderings.
    """
    return 0.038 * mean_side(bounds)


@dataclass(frozen=True)
class AutoConfig(Settings):
    """Settings of method ``auto``."""

    # maximum number of measured points that are aligned
    points: Annotated[int, Range(LEAST_POINTS, 10**6)] = 2000
    hypotheses: Annotated[int, Range(8, 10**5)] = 256  # number of initial poses of a round of search
    # maximum number of rounds of search, each with new hypotheses, until a pose is accepted
    rounds: Annotated[int, Range(1, 100)] = 3
    # steps on rendered rays that refine a pose by depth; 0: none
    refine_steps: Annotated[int, Range(0, 1000)] = 2
    refine_rays: Annotated[int, Range(64, 10**6)] = 512  # number of rays rendered for each of these steps
    landmarks: bool = True  # match image features with the map's landmarks first, if it has any
    # number of rendered rays fused with vague poses by landmarks; 0: nothing is rendered
    fused_rays: Annotated[int, Range(0, 10**6)] = 1024
    # the depth sensor: unknown, kinect, realsense, lidar or rendered
    depth_sensor: Annotated[str, OneOf(DEPTH_SENSORS)] = "unknown"
    # tolerated fraction of wrong answers among the accepted ones; None for the usual acceptance
    risk: float | None = None
    by_colour: Annotated[RefinementSettings, EXPERT] = RefinementSettings()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.risk is not None:
            least_confidence(self.risk)


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """Settings of a tracker."""

    # interval between frames without time stamps, seconds
    frame_seconds: Annotated[float, Above(0.0, 1e4)] = 1 / 30
