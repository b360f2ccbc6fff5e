"""Images without depth on a baked surface: search by drawings, then steps on rendered rays, then a verdict."""

from __future__ import annotations

import time

import torch
from torch import Generator

from bidnerf_core.localization.photometric import Refined
from bidnerf_core.localization.polish import PolishConfig, polished, without_depth
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.rgb_hypotheses import hypotheses
from bidnerf_core.localization.rgb_search import Found, Sight, Stage, search
from bidnerf_core.localization.sketches import OnSurface
from bidnerf_core.localization.thumbnails import Thumbnail, thumbnail
from bidnerf_core.localization.verdict import INDEPENDENT
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.mapping.casting import Cast, cast
from bidnerf_core.se3 import SE3

STAGES = (Stage(16, 0, 48), Stage(16, 8, 12), Stage(24, 8, 4), Stage(48, 8, 2), Stage(96, 5, 2))
OPEN = 0.2
"""Share of what keyframes see that meets nothing, from which on there is a background behind the map."""
LEAD = 0.01
"""Share of its cost by which the next best answer must be worse."""


def rgb_only(problem: Problem, surface: SurfaceMap, count: int, rounds: int, seed: int = 0) -> Localization:
    """Find the pose by colours alone, from ``count`` hypotheses at a time, until an answer is believed.

    A start is one more place to look. Measured depth is not looked at.
    """
    began, generator = time.perf_counter(), Generator().manual_seed(seed)
    problem = without_depth(problem)
    sight, config = surface_sight(problem, surface)
    keyframes, answers = SE3.from_matrix(surface.keyframes), list[tuple[Refined, Found]]()
    while True:
        with torch.no_grad():
            found = search(sight, hypotheses(sight, keyframes, problem.start, count, generator), STAGES)
        answers.append((polished(problem, found.T, config, generator), found))
        refined, found = min(answers, key=lambda answer: answer[0].loss)
        doubt = doubted(refined, found, config)
        if doubt is None or len(answers) == rounds:
            break
    return answered(problem, refined, found, config, began, doubt)


def surface_sight(problem: Problem, surface: SurfaceMap) -> tuple[Sight, PolishConfig]:
    """How far things are, and whether there is a background, is taken from what keyframes see.

    Where there is one, images were rendered over it and are as bright as the map; others may have been exposed otherwise.
    """
    seen = _from_keyframes(surface, thumbnail(problem.views[-1], 16))
    away = float(seen.along[seen.met].median()) if bool(seen.met.any()) else surface.extent
    has_background = float(seen.met.float().mean()) < 1 - OPEN
    sketcher = OnSurface(surface, problem.bounds.background if has_background else None)
    middle = torch.tensor([0.0, 0.0, away])
    return Sight(problem.views, sketcher, middle, surface.extent), PolishConfig(exposure=not has_background)


def _from_keyframes(surface: SurfaceMap, small: Thumbnail, most: int = 16) -> Cast:
    every = max(1, len(surface.keyframes) // most)
    keyframes = SE3.from_matrix(surface.keyframes[::every]).to(small.flat)
    directions = torch.nn.functional.normalize(small.flat, dim=-1) @ keyframes.rotation.mT
    origins = keyframes.translation[:, None].expand_as(directions)
    return cast(surface, origins.reshape(-1, 3), directions.reshape(-1, 3))


def doubted(refined: Refined, found: Found, config: PolishConfig) -> str | None:
    """What speaks against an answer, in words; None where nothing does."""
    if not bool(refined.covariance.isfinite().all()):
        return "what was measured does not determine the pose"
    if not refined.inliers >= config.converged_inliers:
        least = config.converged_inliers
        return f"{refined.inliers:.0%} of fresh rays see what was measured, expected {least:.0%}"
    if not refined.step <= config.converged_step:
        return f"fresh rays ask for a step of {refined.step:.3g}, expected {config.converged_step:g} at most"
    if found.lead < LEAD:
        return "another pose fits about as well"
    return None


def answered(
    problem: Problem, refined: Refined, found: Found, config: PolishConfig, began: float, doubt: str | None
) -> Localization:
    """The way through the search and then over rendered rays is one, and begins at the start if there is one: to choose a
    hypothesis is part of the first step.
    """
    way = [T[i] for T in (found.path[:-1], refined.poses) for i in range(len(T.translation))]
    way[0] = problem.start or way[0]
    # Rays that are side by side err alike: as where depth was measured, those of a view count for a few only.
    covariance = refined.covariance * max(1.0, config.fine_rays / (INDEPENDENT * len(problem.views)))
    return Localization(
        T_world_camera=refined.T.normalized(),
        converged=doubt is None,
        reason=doubt or f"{refined.inliers:.0%} of fresh rays see what was measured",
        steps=len(way) - 1,
        seconds=time.perf_counter() - began,
        loss=refined.loss,
        method="auto",
        poses=SE3.stack(way),
        losses=torch.cat([found.losses, refined.losses]),
        covariance=covariance if bool(covariance.isfinite().all()) else None,
    )
