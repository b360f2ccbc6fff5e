"""``Method``, with which plugins register their own localization methods; the registry of methods; and the methods that need a start.

The first-order methods apply Adam to the loss of sampled rays. ``bid`` uses colour and depth of one or several images at the coarse level
(BID-NeRF, Alg. 1). ``inerf`` uses the colours of one image in full detail (Yen-Chen et al. 2021, iNeRF): those of the field itself, which a
NeRF renders hierarchically with its coarse and fine networks. iNeRF optimizes the magnitude and axis of one screw motion from the start;
here, each step is a separate update in the same frame, the world's. The two differ only to second order, and such an update has no axis
that is undefined at magnitude 0.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Generator

from bidnerf_core.devices import move_to
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.accept import Support, support
from bidnerf_core.localization.adam import follow_gradient, recent_loss
from bidnerf_core.localization.problem import Problem, middle_of_view, pivot
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.search import RayTerms, states_at
from bidnerf_core.localization.settings import (
    AdamSettings,
    ColourSettings,
    DepthLossSettings,
    DepthSettings,
    DescentSettings,
    ReachSettings,
    objective_of,
    rendered_depth_scale,
)
from bidnerf_core.localization.terms.sampled import SampledLoss
from bidnerf_core.registry import USUAL_METHOD as USUAL_METHOD
from bidnerf_core.registry import PluginError, Plugins, interface_defects
from bidnerf_core.settings import Settings, from_flat

RAYS = 1024
"""Number of rays by which the pose that a first-order method found is judged."""


@dataclass(frozen=True)
class Method:
    """A localization method: its solver, its settings, its inputs and its presets.

    If its settings have the names of those of ``auto``, trackers and collections of maps use them as well: ``landmarks``, whether images are
    matched with landmarks; ``depth_sensor``; ``fused_rays``, a number of rays; and ``risk``.
    """

    solve: Callable[[Problem, Any, int], Localization]
    """Solves a problem with settings of ``config_type``; all random choices are drawn from the seed."""
    config_type: type  # a frozen dataclass of settings, with a default for every field
    needs_start: bool  # whether it needs a guess at the pose
    uses_depth: bool = True  # whether it uses measured depth
    presets: Mapping[str, Any] = field(default_factory=dict)  # alternatives to the default settings, by name
    uses_landmarks: bool = False  # whether the map's landmarks are prepared for it, as ``Problem.matcher``
    summary: str = field(kw_only=True)  # one line

    def settings(self, preset: str | None = None) -> Any:
        """Return the default settings or those of a preset. Raises ``InputError`` for an unknown preset."""
        if preset is None:
            return self.config_type()
        if preset not in self.presets:
            offered = ", ".join(self.presets) or "none"
            raise InputError(f"preset {preset!r} is unknown, this method offers {offered}")
        return self.presets[preset]


def _defects(method: Any) -> Iterator[str]:
    if not isinstance(method, Method):
        yield f"it is a {type(method).__name__}, expected a bidnerf_core.localization.Method"
        return
    yield from interface_defects(method, ("summary", "config_type"), {"solve": ("problem", "config", "seed")})


METHODS: Plugins[Method] = Plugins("methods", _defects, first=("auto", "bid", "inerf"))
"""The localization methods by name, those of plugins included."""


def find_method(name: str) -> Method:
    """Return a method by name. Raises ``PluginError`` (an ``InputError``) for an unknown name or a broken plugin."""
    return METHODS.load(name)


def require_use_of_depth(method: str) -> None:
    """Raise ``InputError`` for a method that would ignore explicitly given depth points."""
    _require(method, lambda chosen: chosen.uses_depth, "uses colour alone, got depth points; use method")


def require_start(method: str, given: bool) -> None:
    """Raise ``InputError`` if a method needs a start and none is ``given``."""
    _require(
        method, lambda chosen: given or not chosen.needs_start, "needs a start; give one by --start, or use method"
    )


def _require(method: str, fits: Callable[[Method], bool], problem: str) -> None:
    """Raise ``InputError`` with the ``problem`` unless a method ``fits``; the message names the methods that do and can be loaded."""
    if fits(find_method(method)):
        return
    others = []
    for name in METHODS:
        with contextlib.suppress(PluginError):
            others += [repr(name)] if fits(METHODS[name]) else []
    raise InputError(f"method {method!r} {problem} {' or '.join(others) or '(none has that)'}")


def matches_landmarks(method: str, config: Any) -> bool:
    """Return whether a method, with these settings, matches images with a map's landmarks."""
    return find_method(method).uses_landmarks and getattr(config, "landmarks", True)


def settings_of(method: str, values: dict[str, Any], where: str = "config", preset: str | None = None) -> Any:
    """Return a method's settings; ``values`` are the settings, by flat name, that differ from its defaults or a preset.

    Raises ``InputError``, prefixed with ``where``, for an unknown method or name, or a value that is not allowed.
    """
    return from_flat(find_method(method).settings(preset), values, where)


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
    began, start, device = time.perf_counter(), problem.start_for(method), problem.device
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
    rays = RayTerms(config.colour, by_depth, False).term(problem, RAYS, seed, config.descent.level)
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
