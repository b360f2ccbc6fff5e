"""Poses by comparing images with renderings of the baked surface, in rounds of search and refinement on rendered rays."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Generator

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.acceptance import is_blank
from bidnerf_core.localization.by_colour import ColourAnswer, localization_of, refine_by_colour, usual_stages
from bidnerf_core.localization.by_landmarks import is_sharp
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import refine
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search.by_images import (
    COMPARED_SCALES,
    DETAILED_SCALES,
    DETAILED_STAGES,
    IMAGE_STAGES,
    ImageSearch,
    ImageStage,
)
from bidnerf_core.localization.search.halving import SearchResult
from bidnerf_core.localization.search.starts import Surroundings, hypotheses_for_images
from bidnerf_core.localization.settings import AutoConfig, ByColourConfig
from bidnerf_core.mapping import SurfaceMap

MANY_RAYS = 4
"""Factor by which more rays are rendered if part of the scene may be hidden."""
MANY_LANDMARKS = 500
"""Minimum number of landmarks of a textured scene."""


@dataclass(frozen=True, eq=False)
class _Round:
    """A search by images, and the function that refines the poses found and accepts or rejects the best."""

    search: ImageSearch
    stages: Sequence[ImageStage]
    refined: Callable[[Problem, SearchResult, ByColourConfig, Generator], ColourAnswer]


def localized_by_images(problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int) -> Localization:
    """Compare the images with renderings of the surface, in rounds until an answer is accepted, and refine each answer.

    The first round is fast. The others assume that part of the scene is hidden. If no answer is accepted, the one that explains
    most of the images is returned.
    """
    began, generator = time.perf_counter(), Generator().manual_seed(seed)
    search = ImageSearch.on_surface(problem, surface)
    first = _Round(search, IMAGE_STAGES, refine_by_colour)
    detailed = _Round(replace(search, scales=DETAILED_SCALES), DETAILED_STAGES, _refined_robustly)
    known = Surroundings(
        SE3.from_matrix(surface.keyframes).to("cpu"), surface.extent, torch.zeros(3), search.middle
    )
    blank = all(is_blank(view.frame) for view in problem.views)
    hopeless = blank or (config.landmarks and _is_hopeless(problem))
    answers: list[ColourAnswer] = []
    for this in (first, *(config.rounds - 1) * (detailed,)):
        with torch.no_grad():
            many = hypotheses_for_images(known, problem.start, config.hypotheses, generator)
            found = this.search(many, this.stages)
        if hopeless:
            return _unrefined(found, _unrecognised(problem, blank), began)
        answers.append(this.refined(problem, found, config.by_colour, generator))
        if answers[-1].verdict.accepted:
            return localization_of(problem, answers[-1], config.by_colour, began, "auto")
    judge, width = replace(search, scales=COMPARED_SCALES), IMAGE_STAGES[-1].width
    best = min(answers, key=lambda answer: judge.cost(answer.refined.T, width))
    return localization_of(problem, best, config.by_colour, began, "auto")


def _refined_robustly(
    problem: Problem, search: SearchResult, config: ByColourConfig, generator: Generator
) -> ColourAnswer:
    """Refine the best pose of a search on many rays with a redescending loss, then accept or reject it like any other pose.

    If half of the rays are outliers, refinement on few rays or at a coarse level drifts away from the true pose.
    """
    *_, fine = usual_stages(config, 1)
    many = replace(fine, rays=MANY_RAYS * fine.rays, colour_scale=fine.colour_scale / 2)
    robust = replace(config.colour, colour_loss="geman-mcclure")
    settings = RenderedCostSettings(robust, None, config.refinement)
    T = refine(problem, search.T[:1], (many,), settings, generator).T
    both = replace(search, T=SE3.cat([T[None], search.T[1:]]))
    return refine_by_colour(problem, both, config, generator, (replace(fine, steps=0),))


def _is_hopeless(problem: Problem) -> bool:
    """Return whether an image without recognised landmarks cannot be localized, as the scene is textured but the field blurred."""
    textured = problem.matcher is not None and len(problem.matcher.landmarks) >= MANY_LANDMARKS
    return textured and not is_sharp(problem)


def _unrecognised(problem: Problem, blank: bool) -> Verdict:
    """Return the rejection of an image that is blank, or without recognised landmarks in a blurred field."""
    if blank:
        return Verdict(Outcome.UNDETERMINED, "the image has a single colour, as if the lens were covered")
    causes = "the image may show another place, or be too dark, too blurred or taken from too far away"
    focal = ", or its focal length may be too far off" if problem.focal_is_approximate else ""
    why = f"too few landmarks were recognised, and the field is not sharp enough to compare images with it: {causes}{focal}"
    return Verdict(Outcome.TOO_FEW_MATCHES, why)


def _unrefined(found: SearchResult, verdict: Verdict, began: float) -> Localization:
    """Return the best pose of a search by images as rejected, without refinement, which would take many seconds."""
    return Localization(
        T_world_camera=found.T[0].normalized(),
        outcome=verdict.outcome,
        reason=verdict.reason,
        steps=len(found.losses),
        seconds=time.perf_counter() - began,
        loss=float(found.scores[0]),
        method="auto",
        poses=found.path,
        losses=found.losses,
    )
