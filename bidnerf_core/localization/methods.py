"""``Method``, by which plugins register their own localization methods, the methods by name, and those that need a start.

The first-order methods are Adam on the loss of sampled rays: ``bid`` uses colour and depth of one or several images at the coarse level
(BID-NeRF, Alg. 1), and ``inerf`` the colours of one image in full detail (Yen-Chen et al. 2021, iNeRF), that is, of the field itself,
which a NeRF renders hierarchically with its coarse and fine networks. iNeRF optimizes the magnitude and axis of one screw motion
from the start; here, each step is a separate update in the same frame, the world's. The two differ to second order, and updates have
no axis that is undefined at magnitude 0.

The second-order methods halve poses around the start from coarse to fine: ``bid-lm`` on colour and depth, ``inerf-lm`` on colour.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Annotated, Any

import torch
from torch import Generator

from bidnerf_core.depth import UNKNOWN_SENSOR
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.adam import History, follow_gradient
from bidnerf_core.localization.by_rays import (
    COLOUR_SIGMA,
    SHAPE_SIGMA,
    RayStage,
    RayTerms,
    centred,
    localization_by_rays,
)
from bidnerf_core.localization.pivots import middle_of_view, pivot
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search import Stage, halve, image_stages, neighbours, states_at
from bidnerf_core.localization.settings import (
    AdamSettings,
    ColourRefinementSettings,
    ColourSettings,
    DepthLossSettings,
    DepthSettings,
    DescentSettings,
    ReachSettings,
    RenderedThresholds,
    SpreadSettings,
    objective_of,
    rendered_depth_scale,
)
from bidnerf_core.localization.support import DescentDiagnostics, support
from bidnerf_core.localization.terms.images import ColourScales, field_renderer
from bidnerf_core.localization.terms.sampled import SampledLoss
from bidnerf_core.registry import PluginError, Plugins, interface_defects
from bidnerf_core.settings import EXPERT, Range, Settings, from_flat


@dataclass(frozen=True)
class SharedSettings:
    """Settings of a method that trackers, collections of maps and the command line take into account as well."""

    matches_landmarks: bool = True  # whether images are matched with the map's landmarks
    depth_sensor: str = UNKNOWN_SENSOR  # name of the sensor that measured the depth
    rays: int = 0  # number of rays that may be rendered to compare explanations of an image
    risk: float | None = None  # tolerated fraction of wrong answers among the accepted ones


@dataclass(frozen=True)
class Method:
    """A localization method: how it finds poses, its settings, what it needs and what it offers."""

    solve: Callable[[Problem, Any, int], Localization]
    """Solves a problem with settings of ``config_type``; all random choices are drawn from the seed."""
    config_type: type  # a frozen dataclass of settings, with a default for every field
    needs_start: bool  # whether it needs a guess at the pose
    uses_depth: bool = True  # whether it uses measured depth
    presets: Mapping[str, Any] = field(default_factory=dict)  # alternatives to the default settings, by name
    uses_landmarks: bool = False  # whether the map's landmarks are prepared for it, as ``Problem.matcher``
    # returns those of its settings that matter elsewhere too
    shared: Callable[[Any], SharedSettings] = lambda config: SharedSettings()
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


METHODS: Plugins[Method] = Plugins("methods", _defects, first=("auto", "bid", "inerf", "bid-lm", "inerf-lm"))
"""The methods by name."""
USUAL_METHOD = "auto"
"""The name of the default method."""


def find_method(name: str) -> Method:
    """Return a method by name. Raises ``PluginError`` (an ``InputError``) for an unknown name or a broken plugin."""
    return METHODS.load(name)


def require_use_of_depth(method: str) -> None:
    """Raise ``InputError`` for a method that would ignore explicitly given depth points."""
    if not find_method(method).uses_depth:
        others = _names_of(lambda other: other.uses_depth)
        raise InputError(f"method {method!r} uses colour alone, got depth points; use method {others}")


def require_start(method: str, given: bool) -> None:
    """Raise ``InputError`` for a method that needs a start if none is given."""
    if find_method(method).needs_start and not given:
        others = _names_of(lambda other: not other.needs_start)
        raise InputError(f"method {method!r} needs a start; give one by --start, or use method {others}")


def _names_of(wanted: Callable[[Method], bool]) -> str:
    """Return the names of the methods with a property, except those that cannot be loaded."""
    found = []
    for name in METHODS:
        with contextlib.suppress(PluginError):
            found += [name] if wanted(METHODS[name]) else []
    return " or ".join(map(repr, found)) or "(none has that)"


def matches_landmarks(method: str, config: Any) -> bool:
    """Return whether a method, with these settings, matches images with a map's landmarks."""
    chosen = find_method(method)
    return chosen.uses_landmarks and chosen.shared(config).matches_landmarks


def settings_of(method: str, values: dict[str, Any], where: str = "config", preset: str | None = None) -> Any:
    """Return a method's settings; ``values`` are those that differ from its defaults or a preset, by their flat names.

    Raises ``InputError``, prefixed with ``where``, for an unknown method or name, or a value that is not allowed.
    """
    return from_flat(find_method(method).settings(preset), values, where)


# First-order methods.

SUPPORTING_RAYS = 1024
"""Number of rays, not used in the fit, on which a pose is compared with its rivals."""
PAPER_STEPS = AdamSettings(max_steps=1000, learning_rate=0.02, decay=0.8, decay_steps=100)
"""The paper's number of steps, with iNeRF's decay. The paper does not give its learning rate; this one is provisional."""
PAPER_DEPTH = DepthSettings(depth_scale=0.1)


@dataclass(frozen=True)
class BidConfig(Settings):
    """Settings of method ``bid``."""

    # The camera's own frame is the paper's pivot.
    descent: DescentSettings = DescentSettings(level=0, pivot="scene")
    adam: AdamSettings = AdamSettings(decay=0.4, decay_steps=80)
    colour: ColourSettings = ColourSettings()
    depth: DepthSettings = DepthSettings()
    # Favour pixels on matter, and keep measured points in the scene's box: the best variant on Lego (``benchmarks/bid_variants.py``).
    reach: ReachSettings = ReachSettings(candidates=3, box_weight=1.0)


@dataclass(frozen=True)
class InerfConfig(Settings):
    """Settings of method ``inerf``: the learning rate and its decay are iNeRF's (section 4)."""

    descent: DescentSettings = DescentSettings(pixels="interest-regions", pivot="world")
    adam: AdamSettings = AdamSettings(max_steps=300, learning_rate=0.01)
    colour: ColourSettings = ColourSettings(colour_loss="l2")


def bid(problem: Problem, config: BidConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start``; pixels are drawn from ``seed``."""
    return descended(problem, config, config.depth, config.reach, seed, "bid")


def inerf(problem: Problem, config: InerfConfig, seed: int = 0) -> Localization:
    """Descend from ``problem.start`` on colour alone. Raises ``InputError`` for more than one image."""
    if len(problem.views) > 1:
        raise InputError(f"method inerf takes one image, got {len(problem.views)}; method bid takes several")
    return descended(problem, config, None, ReachSettings(), seed, "inerf")


def descended(
    problem: Problem, config: BidConfig | InerfConfig, depth: DepthSettings | None, reach: ReachSettings, seed: int, method: str
) -> Localization:  # fmt: skip
    """Descend with Adam from ``problem.start`` (Alg. 1), then accept or reject the pose.

    Low-contrast images have a small loss even at a wrong pose, so it must also be supported by other rays.
    """
    began, start, adam = time.perf_counter(), problem.start_for(method), config.adam
    if depth is not None and depth.depth_scale is None:
        depth = replace(depth, depth_scale=rendered_depth_scale(problem.bounds))
    objective = objective_of(config.colour, depth)
    there, generator = problem.on_device(), Generator(problem.device).manual_seed(seed)
    own = 0 if depth is None else depth.depth_rays
    loss = SampledLoss(there, objective, own, config.descent, reach, generator)
    history = History([start])
    about = pivot(config.descent.pivot, problem)
    finite, reason = follow_gradient(loss, about, adam, history, problem.device, generator)
    T, mean = history.answer(adam.answer)
    # How well rays that were not used distinguish the pose from its rivals.
    terms = RayTerms(
        config.colour,
        None if depth is None else DepthLossSettings(depth.depth_weight, depth.depth_loss, depth.depth_scale),
        False,
    )
    rays = terms.term(problem, RayStage(0, SUPPORTING_RAYS, level=config.descent.level), seed)
    is_pose = bool(T.matrix().isfinite().all())
    middle = middle_of_view(problem, T if is_pose else None)
    found = support(lambda T: rays.costs(states_at(T)), T, middle, rays.plain_costs())
    why = f"{reason}; mean loss {mean:.3g}, must be below {adam.converged_loss:.3g}"
    if not finite or not math.isfinite(mean):
        verdict = Verdict(Outcome.DIVERGED, reason)
    elif mean >= adam.converged_loss:
        verdict = Verdict(Outcome.HIGH_LOSS, why)
    else:
        verdict = Verdict(Outcome.CONVERGED, why, found.confidence)
        rejection = found.rejection(1 - adam.plain_share)
        verdict = (
            verdict if rejection is None else replace(rejection, reason=f"{why}, but {rejection.reason}")
        )
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


BID = Method(
    bid,
    BidConfig,
    needs_start=True,
    # The paper's settings, with updates in the camera's frame as in its Alg. 1, and about the middle of the scene as by default.
    presets={
        "paper": BidConfig(
            DescentSettings(level=0, pivot="camera"), PAPER_STEPS, depth=PAPER_DEPTH, reach=ReachSettings()
        ),
        "paper-scene": BidConfig(
            DescentSettings(level=0, pivot="scene"), PAPER_STEPS, depth=PAPER_DEPTH, reach=ReachSettings()
        ),
    },
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


# Second-order methods.

Steps = Annotated[int, Range(1, 10**5)]
ExpertCount = Annotated[int, Range(1, 10**5), EXPERT]
RayCount = Annotated[int, Range(7, 10**7)]
ExpertRays = Annotated[int, Range(7, 10**7), EXPERT]


@dataclass(frozen=True)
class BidLmStages(Settings):
    """Settings of the stages, from many poses on few rays at the coarsest level to one pose on many rays."""

    search_rays: ExpertRays = 128  # number of rays by which each of the poses around the start is ranked
    coarse_poses: ExpertCount = 6  # number of best poses that take steps at the coarsest level
    coarse_steps: ExpertCount = 4  # steps of each of the coarse poses
    coarse_rays: ExpertRays = 128  # number of rays for each of the coarse poses
    middle_poses: ExpertCount = 2  # number of best coarse poses that take further steps
    middle_steps: ExpertCount = 4  # steps of each of the middle poses
    middle_rays: ExpertRays = 256  # number of rays for each of the middle poses
    fine_steps: Steps = 6  # steps of the best pose, in full detail
    fine_rays: RayCount = 1024  # number of rays rendered for each of the fine steps
    # width, in pixels, of the squares over which colours are averaged in coarse steps
    blur: Annotated[int, Range(1, 10**4), EXPERT] = 8

    def stages(self) -> list[RayStage]:
        return [
            RayStage(0, self.search_rays, self.coarse_poses, 0, self.blur, 3.0),
            RayStage(self.coarse_steps, self.coarse_rays, self.middle_poses, 0, self.blur, sigma=SHAPE_SIGMA),
            RayStage(self.middle_steps, self.middle_rays, 1, 0, self.blur, sigma=SHAPE_SIGMA),
            RayStage(self.fine_steps, self.fine_rays, sigma=SHAPE_SIGMA / 3),
        ]


@dataclass(frozen=True)
class ImageSearchSettings(Settings):
    """Settings of the search with small renderings, which grow as the number of poses decreases."""

    search_poses: ExpertCount = 24  # number of best poses that take steps on small renderings
    search_steps: ExpertCount = 8  # steps of each of the search poses
    middle_poses: ExpertCount = 6  # number of best search poses that take steps on larger renderings
    middle_steps: ExpertCount = 6  # steps of each of the middle poses
    last_steps: ExpertCount = 4  # steps of the best two poses, on the largest renderings
    # longer side of the first renderings, pixels; the last ones are 3 times as large
    width: Annotated[int, Range(4, 1000)] = 16

    def stages(self) -> list[tuple[int, int, int]]:
        return [
            (self.width, 0, self.search_poses),
            (self.width, self.search_steps, self.middle_poses),
            (self.width * 3 // 2, self.middle_steps, 2),
            (self.width * 3, self.last_steps, 2),
        ]


def _small_images(problem: Problem, search: ImageSearchSettings) -> Iterable[Stage]:
    """Yield the stages of a comparison with small renderings of the field's coarsest level."""
    renderer = field_renderer(problem.level(0), problem.bounds)
    return image_stages(problem, renderer, problem.device, ColourScales(), search.stages())


@dataclass(frozen=True)
class BidLmConfig(Settings):
    """Settings of method ``bid-lm``."""

    spread: SpreadSettings = SpreadSettings()
    stages: BidLmStages = BidLmStages()
    colour: ColourSettings = ColourSettings()
    depth: DepthLossSettings = DepthLossSettings()
    exposure: bool = False  # estimate a gain and an offset for each colour channel
    thresholds: RenderedThresholds = RenderedThresholds()


def bid_lm(problem: Problem, config: BidLmConfig, seed: int = 0) -> Localization:
    """Refine poses around ``problem.start``; poses and pixels are drawn from ``seed``.

    Colours alone have a narrow basin of convergence, so images without depth are first compared with small renderings.
    """
    began, start = time.perf_counter(), problem.start_for("bid-lm")
    middle = middle_of_view(problem, start)
    poses = _around(start, config.spread, 0.1, middle, seed)
    terms, stages = RayTerms(config.colour, config.depth, config.exposure), config.stages.stages()
    first: Iterable[Stage] = ()
    if problem.has_depth:
        poses = SE3.cat([poses, centred(problem, poses, middle)])
    else:
        first, stages = _small_images(problem, ImageSearchSettings()), stages[2:]
    found = halve(states_at(poses), chain(first, terms.stages(problem, stages, seed)), middle, problem.device)
    fresh = terms.term(problem, stages[-1], seed + len(stages))
    return localization_by_rays(problem, found, fresh, middle, config.thresholds, "bid-lm", began)


def _around(start: SE3, spread: SpreadSettings, share: float, middle: torch.Tensor, seed: int) -> SE3:
    """Return poses around the start; ``share`` is the usual displacement relative to the distance of the scene."""
    along = spread.spread_translation
    along = share * float(middle.norm()) if along is None else along
    return neighbours(start, spread.poses, along, spread.spread_rotation, seed)


BID_LM = Method(
    bid_lm,
    BidLmConfig,
    needs_start=True,
    summary="second-order steps on colour and depth, from coarse to fine",
)


@dataclass(frozen=True)
class InerfLmConfig(Settings):
    """Settings of method ``inerf-lm``."""

    spread: SpreadSettings = SpreadSettings(256, spread_rotation=0.25)
    search: ImageSearchSettings = ImageSearchSettings()
    steps: ColourRefinementSettings = ColourRefinementSettings()
    colour: ColourSettings = ColourSettings()
    exposure: bool = False  # estimate a gain and an offset for each colour channel
    thresholds: RenderedThresholds = RenderedThresholds()


def inerf_lm(problem: Problem, config: InerfLmConfig, seed: int = 0) -> Localization:
    """Refine poses around ``problem.start``; poses and pixels are drawn from ``seed``.

    It needs only the field, and uses neither measured depth nor a baked surface.
    """
    began, start, steps = time.perf_counter(), problem.start_for("inerf-lm"), config.steps
    problem = problem.without_depth()
    middle = middle_of_view(problem, start)
    stages = [
        RayStage(steps.coarse_steps, steps.coarse_rays, 2, 0, 2, sigma=COLOUR_SIGMA),
        RayStage(steps.fine_steps, steps.fine_rays, sigma=COLOUR_SIGMA / 2),
    ]
    terms = RayTerms(config.colour, None, config.exposure)
    poses = states_at(_around(start, config.spread, 0.04, middle, seed))
    first = _small_images(problem, config.search)
    found = halve(poses, chain(first, terms.stages(problem, stages, seed)), middle, problem.device)
    fresh = terms.term(problem, stages[-1], seed + len(stages))
    return localization_by_rays(problem, found, fresh, middle, config.thresholds, "inerf-lm", began)


INERF_LM = Method(
    inerf_lm,
    InerfLmConfig,
    needs_start=True,
    uses_depth=False,
    summary="second-order steps on colour alone, from coarse to fine",
)
