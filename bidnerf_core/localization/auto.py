"""Method ``auto``: find the pose on the baked surface, with a start or without one, refine it on what the field itself
shows, and say whether to believe it.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch
from torch import Generator

from bidnerf_core.errors import InputError
from bidnerf_core.localization.alignment import Cloud
from bidnerf_core.localization.bid import BidConfig, bid
from bidnerf_core.localization.clouds import measured_cloud
from bidnerf_core.localization.hypotheses import hypotheses
from bidnerf_core.localization.photometric import stepped
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.search import Found, score, search
from bidnerf_core.localization.settings import Judged
from bidnerf_core.localization.stages import Refinement, Stage
from bidnerf_core.localization.verdict import Bars, covariance, evidence
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.se3 import SE3

LEAST_POINTS = 50
"""With fewer there is no shape to recognise."""
WORSE = 0.05
"""By how much refinement may raise the cost on the surface; a field that asks for more does not show what was baked."""


@dataclass(frozen=True)
class AutoConfig(Judged):
    """Settings of method ``auto``."""

    points: int = 2000  # of the measured pixels, at most
    hypotheses: int = 256  # that a round of the search begins with
    rounds: int = 3  # of search, each with fresh hypotheses, until an answer is believed
    refine_steps: int = 2  # on rendered rays, of the answer; 0: the surface has the last word
    refine_rays: int = 512

    def __post_init__(self) -> None:
        for name, least, most in (
            ("points", LEAST_POINTS, 10**6), ("hypotheses", 8, 10**5), ("rounds", 1, 100),
            ("refine_steps", 0, 1000), ("refine_rays", 64, 10**6),
        ):  # fmt: skip
            self._require(name, least <= getattr(self, name) <= most, f"{least} to {most}")


def auto(problem: Problem, config: AutoConfig, seed: int = 0) -> Localization:
    """Search and align where there is measured depth and a baked surface; descend as ``bid`` does where there is not.

    Raises ``InputError`` where that needs a start and there is none.
    """
    began = time.perf_counter()
    generator = Generator().manual_seed(seed)
    if problem.surface is None:
        return _descended(problem, seed, "the map has no surface ('bidnerf bake' makes one)")
    cloud = measured_cloud(problem, config.points, generator)
    if len(cloud) < LEAST_POINTS:
        return _descended(problem, seed, f"{len(cloud)} pixels have depth, expected {LEAST_POINTS} or more")
    with torch.no_grad():
        found = _searched(problem, problem.surface, cloud, config, generator)
    shown = 1.0
    if config.refine_steps:
        found, shown = _refined(problem, problem.surface, cloud, found, config, generator)
    with torch.no_grad():
        speaks = replace(evidence(problem.surface, cloud, found), shown=shown)
        doubt = speaks.doubt(Bars())
        spread = covariance(problem.surface, cloud, found.T, len(problem.views))
        path = _way(problem.start, found.path)
        losses = score(problem.surface, cloud.first(200), path)
    return Localization(
        T_world_camera=found.T.normalized(),
        converged=doubt is None,
        reason=doubt or f"{speaks.alike:.0%} of the measured points have place and colour of the surface",
        steps=len(losses) - 1,
        seconds=time.perf_counter() - began,
        loss=found.score,
        method="auto",
        poses=path,
        losses=losses[:-1],
        covariance=spread,
    )


def _searched(
    problem: Problem, surface: SurfaceMap, cloud: Cloud, config: AutoConfig, generator: Generator
) -> Found:
    """Rounds of search until an answer is believed; else the best of them."""
    answers: list[Found] = []
    while True:
        pool = hypotheses(surface, cloud, problem.start, config.hypotheses, generator)
        answers.append(search(surface, cloud, pool))
        best = min(answers, key=lambda found: found.score)
        if len(answers) == config.rounds or evidence(surface, cloud, best).doubt(Bars()) is None:
            return best


def _refined(
    problem: Problem,
    surface: SurfaceMap,
    cloud: Cloud,
    found: Found,
    config: AutoConfig,
    generator: Generator,
) -> tuple[Found, float]:
    """A finer pose, and the share of rendered rays that see from there what was measured.

    The surface is as coarse as its cells; the field is not, and has seen every pixel of the training images.
    """
    cell = surface.cell
    stage = Stage(config.refine_steps, config.refine_rays, depth_scale=6 * cell, play=cell / 2)
    steps = stepped(problem, found.T, stage, Refinement(), generator)
    with torch.no_grad():
        scores = score(surface, cloud, steps.poses).tolist()
    if not scores[-1] <= scores[0] + WORSE:
        return found, 0.0
    path = SE3.cat([found.path, steps.poses[1:]])
    return replace(found, T=steps.poses[-1], score=scores[-1], path=path), steps.inliers


def _way(start: SE3 | None, path: SE3) -> SE3:
    """It begins at the start if there is one: to choose a hypothesis is part of the first step."""
    return path if start is None else SE3.cat([start[None], path[1:]])


def _descended(problem: Problem, seed: int, why: str) -> Localization:
    if problem.start is None:
        raise InputError(f"{why}: method 'auto' needs a start then; give one")
    found = bid(problem, BidConfig(), seed)
    return replace(found, reason=f"{why}; {found.reason}")
