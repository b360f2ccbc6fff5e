"""Poses by comparing images with renderings of the baked surface: rounds of search, each refined on rendered rays."""

from __future__ import annotations

import time
from dataclasses import replace

import torch
from torch import Generator

from bidnerf_core.localization.auto_config import AutoConfig
from bidnerf_core.localization.by_colour import ColourAnswer, localization_of, refine_by_colour
from bidnerf_core.localization.by_landmarks import is_sharp
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome
from bidnerf_core.localization.search.by_images import (
    DETAILED_SCALES,
    DETAILED_STAGES,
    IMAGE_STAGES,
    ImageSearch,
)
from bidnerf_core.localization.search.halving import SearchResult
from bidnerf_core.localization.search.hypotheses import Surroundings, hypotheses_for_images
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.se3 import SE3

MANY_LANDMARKS = 500
"""The number of landmarks from which on a scene is textured."""


def localized_by_images(problem: Problem, surface: SurfaceMap, config: AutoConfig, seed: int) -> Localization:
    """Compare the images with renderings of the surface, in rounds until an answer is accepted, and refine each answer.

    From the second round on, the comparison is more detailed and leaves out what may hide part of the scene.
    """
    began, generator = time.perf_counter(), Generator().manual_seed(seed)
    search, stages, answers = ImageSearch.on_surface(problem, surface), IMAGE_STAGES, list[ColourAnswer]()
    detailed = replace(search, scales=DETAILED_SCALES)
    keyframes = SE3.from_matrix(surface.keyframes).to("cpu")
    known = Surroundings(keyframes, surface.extent, torch.zeros(3), search.middle)
    while True:
        with torch.no_grad():
            many = hypotheses_for_images(known, problem.start, config.hypotheses, generator)
            found = search(many, stages)
        if config.landmarks and _is_hopeless(problem):
            return _unrecognised(problem, found, began)
        answers.append(
            refine_by_colour(problem, found, config.by_colour, generator, robust=search is detailed)
        )
        best = min(answers, key=lambda answer: detailed.cost(answer.refined.T))
        if best.verdict.accepted or len(answers) == config.rounds:
            return localization_of(problem, best, config.by_colour, began, "auto")
        search, stages = detailed, DETAILED_STAGES


def _is_hopeless(problem: Problem) -> bool:
    """Whether an image without recognised landmarks cannot be found: the scene is textured, and its field blurred."""
    textured = problem.matcher is not None and len(problem.matcher.landmarks) >= MANY_LANDMARKS
    return textured and not is_sharp(problem)


def _unrecognised(problem: Problem, found: SearchResult, began: float) -> Localization:
    """Return the best pose of a search by images as rejected; refining it on rendered rays would take many seconds."""
    approximate = any(view.frame.focal_is_approximate for view in problem.views)
    focal = "; give the camera's calibration instead of an approximate focal length" if approximate else ""
    return Localization(
        T_world_camera=found.T[0].normalized(),
        outcome=Outcome.TOO_FEW_MATCHES,
        reason=f"too few landmarks were recognised, and the field is too blurred to compare images with its renderings{focal}",
        steps=len(found.losses),
        seconds=time.perf_counter() - began,
        loss=float(found.scores[0]),
        method="auto",
        poses=found.path,
        losses=found.losses,
    )
