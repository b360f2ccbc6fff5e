"""Settings of method ``auto``, in groups that other methods share."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from bidnerf_core.depth import DEPTH_SENSORS
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import RobustName
from bidnerf_core.localization.accept import least_confidence
from bidnerf_core.settings import EXPERT, NotNegative, OneOf, Positive, Range, Settings

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
    # depth difference, metres, at which outliers begin (default: 1.9 % of the scene's mean side)
    depth_scale: Positive | None = None


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
    # sensor that measured the depth: unknown, kinect, realsense, lidar or rendered
    depth_sensor: Annotated[str, OneOf(DEPTH_SENSORS)] = "unknown"
    # tolerated fraction of wrong poses among those accepted (default: accepted as usual)
    risk: Annotated[float | None, "FRACTION"] = None
    # largest position error (in the map's unit) of a right pose (default: 3 % of the distance of the scene)
    tolerance: Positive | None = None
    # The rest is of searches by images, which end with steps on rendered rays, and of their acceptance by newly drawn rays.
    fine_steps: Annotated[int, Range(1, 10**5), EXPERT] = 8  # steps of the best pose, in full detail
    # number of rays rendered for each of the fine steps; earlier steps use a fraction of it
    fine_rays: Annotated[int, Range(7, 10**7), EXPERT] = 1024
    colour: Annotated[ColourSettings, EXPERT] = ColourSettings()
    # minimum inlier fraction of the rays for an accepted pose
    converged_inliers: Annotated[float, Range(0.0), EXPERT] = 0.93

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.risk is not None:
            least_confidence(self.risk)
