"""Settings of the first-order methods, and the objective that they define."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bidnerf_bid.pivot import PivotName
from bidnerf_bid.pixels import DrawerName
from bidnerf_bid.residuals import (
    DEPTH_RESIDUALS,
    Objective,
    colour_term,
    depth_term,
    free_space_term,
    opacity_term,
)
from bidnerf_core.errors import InputError
from bidnerf_core.fields import RadianceField, levels
from bidnerf_core.geometry import Robust
from bidnerf_core.localization import ColourSettings, DepthLossSettings
from bidnerf_core.settings import EXPERT, Above, Count, NotNegative, OneOf, Positive, Range, Settings


@dataclass(frozen=True)
class DepthSettings(DepthLossSettings):
    """Settings of the depth term of first-order steps, which applies where depth was measured."""

    # weight of the depth term, per square metre; the photometric term has weight 1
    depth_weight: NotNegative = 1.0
    # depth difference, metres, at which outliers begin (default: 3.8 % of the scene's mean side)
    depth_scale: Positive | None = None
    # how depths are compared: distance, truncated or first-surface
    depth_residual: Annotated[str, OneOf(DEPTH_RESIDUALS), EXPERT] = "distance"
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
    # level of the field: 0 is the coarsest, -1 the finest, which inerf uses by default
    level: int | None = None
    pixels: DrawerName = "uniform"  # where pixels are drawn: anywhere, at corners, around corners
    pivot: PivotName = "camera"  # what an update rotates about: camera, world, or the middle of the scene
    # length of the sampled interval, in units of [near, far]; the paper's "wide" is 2
    wide: Annotated[float, Above(0.0, 100.0)] = 1.0

    def level_of(self, field: RadianceField) -> RadianceField:
        """Return the level of a field whose number, possibly from the end, is ``level``. Raises ``InputError`` if there is none."""
        if self.level is None:
            return field
        offered = levels(field)
        if not -len(offered) <= self.level < len(offered):
            raise InputError(f"level is {self.level}", expected=f"0 (coarsest) to {len(offered) - 1}")
        return offered[self.level]


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
    # factor by which the learning rate falls every `decay_steps` steps
    decay: Annotated[float, Above(0.0, 1.0)] = 0.8
    # number of steps in which the learning rate falls by the factor `decay`
    decay_steps: Count = 100
    # stop once the mean loss of 20 steps is below this (epsilon in Algorithm 1 of BID-NeRF); 0: never
    stop_loss: NotNegative = 0.0
    converged_loss: NotNegative = 0.02  # mean loss of 20 steps below which the answer counts as converged


@dataclass(frozen=True)
class BidConfig(Settings):
    """Settings of method ``bid``."""

    # The camera's own frame is the paper's pivot.
    descent: DescentSettings = DescentSettings(level=0, pivot="scene")
    adam: AdamSettings = AdamSettings(decay=0.4, decay_steps=80)
    colour: ColourSettings = ColourSettings()
    depth: DepthSettings = DepthSettings()
    # Favour pixels on matter, and keep measured points in the scene's box: the best variant on Lego (records ``bid_depth_*``).
    reach: ReachSettings = ReachSettings(candidates=3, box_weight=1.0)


@dataclass(frozen=True)
class InerfConfig(Settings):
    """Settings of method ``inerf``: the learning rate and its decay are iNeRF's (section 4)."""

    descent: DescentSettings = DescentSettings(pixels="interest-regions", pivot="world")
    adam: AdamSettings = AdamSettings(max_steps=300, learning_rate=0.01)
    colour: ColourSettings = ColourSettings(colour_loss="l2")
