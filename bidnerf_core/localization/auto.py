"""Method ``auto``: find the pose with or without a start, from all available measurements, and decide whether to trust it.

If the map has landmarks, they are matched first, and the resulting pose is fused with measured depth and rendered rays. If the map has
no landmarks, or has few and that pose is not accepted, the surface is searched: measured points are aligned with the surface if there
is enough depth; otherwise, the images are compared with renderings of the surface, in a map with landmarks only if its trial missed some
of the map's own images. In a map with neither surface nor landmarks, ``auto`` needs a start, from which it descends as ``bid`` does.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch

from bidnerf_core.depth import find_depth_sensor
from bidnerf_core.errors import InputError
from bidnerf_core.localization.accept import Evidence, least_confidence
from bidnerf_core.localization.by_surface import localize_by_depth, localize_by_images
from bidnerf_core.localization.loop import Loop
from bidnerf_core.localization.methods import METHODS, Method
from bidnerf_core.localization.posterior import mass_within
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.search import without_pose
from bidnerf_core.localization.settings import AutoConfig


def auto(problem: Problem, config: AutoConfig, seed: int = 0) -> Localization:
    """Find the pose from landmarks, else by a search on the surface, else by descent from a start.

    Raises ``InputError`` if the map has neither landmarks nor a baked surface, and there is no start.
    """
    began = time.perf_counter()
    problem = replace(problem, sensor=find_depth_sensor(config.depth_sensor))
    matcher = problem.matcher if config.landmarks else None
    loop = None if matcher is None else Loop(problem.views, matcher, problem, config.fused_rays, seed)
    best: Localization | None = None
    for found in answers(problem, config, seed, loop):
        best = found if best is None or is_better(found, best) else best
        # No other measurement can correct a pose with these outcomes.
        if best.outcome in (Outcome.CONVERGED, Outcome.MISCALIBRATED, Outcome.MIRRORED, Outcome.AMBIGUOUS):
            break
    best = best or unrecognized(problem)
    explained = best.converged or best.outcome is Outcome.UNDETERMINED
    if problem.matcher is None and problem.surface is not None and not explained:
        best = replace(best, reason=f"{best.reason}; the map has no landmarks ('bidnerf bake' makes them)")
    return within_limits(replace(best, seconds=time.perf_counter() - began), config)


def answers(problem: Problem, config: AutoConfig, seed: int, loop: Loop | None) -> Iterator[Localization]:
    """Yield answers, those that take the least time first: by landmarks and the start, by measured depth, and by images of the surface.

    A map with neither landmarks nor a surface has one answer, by a descent from the start.
    """
    began, surface = time.perf_counter(), problem.surface
    if loop is not None:
        if (answer := loop()) is not None:
            yield answer.localization(problem, began)
    elif surface is None:
        why = "the map has no surface ('bidnerf bake' makes one)"
        if problem.start is None:
            raise InputError("method 'auto' then needs a start; give one", where=why)
        method = METHODS.load("bid", f"{why}, so method 'auto' descends as 'bid' does")
        descended = method.solve(problem, method.settings(), seed)
        yield replace(descended, reason=f"{why}; {descended.reason}")
    # If the map's own images usually have 150 matches, an image without recognised landmarks shows something else.
    if surface is None or (loop is not None and loop.landmarks.usual_matches >= 150):
        return
    config = config if loop is None else replace(config, rounds=1)
    found = localize_by_depth(problem, surface, config, seed, loop)
    # Images take longer than points to search; in a map whose own images were all recognised, landmarks suffice.
    if found is None and (loop is None or loop.landmarks.trial.found < loop.landmarks.trial.images):
        found = localize_by_images(problem, surface, config, seed, loop)
    if found is not None:
        yield found


def is_better(found: Localization, best: Localization) -> bool:
    """Return whether a further answer replaces the best of those before it."""
    # A landmark-based pose with too few matches is a pose by chance.
    if best.outcome is Outcome.TOO_FEW_MATCHES:
        return True
    # Of five poses that only the surface supported, where landmarks had found an uncertain one, three were wrong (``answers_new``).
    by_landmarks = isinstance(found.diagnostics, Evidence)
    return found.converged and (by_landmarks or best.outcome is not Outcome.UNCERTAIN)


def localize_by_landmarks(problem: Problem, rays: int, seed: int) -> Localization:
    """Localize from landmarks, fused with measured depth and up to ``rays`` rendered rays."""
    assert problem.matcher is not None
    began = time.perf_counter()
    answer = Loop(problem.views, problem.matcher, problem, rays, seed)()
    return unrecognized(problem) if answer is None else answer.localization(problem, began)


def unrecognized(problem: Problem) -> Localization:
    """Return the rejected answer for images in which no landmarks were recognised."""
    causes = "the image may show another place, or be too dark, too blurred or taken from too far away"
    why = Verdict(Outcome.TOO_FEW_MATCHES, f"too few landmarks were recognised: {causes}")
    return without_pose(problem, why)


def within_risk(found: Localization, risk: float | None) -> Localization:
    """Return the answer, rejected as ``uncertain`` if its confidence is not from landmarks or is lower than ``risk`` requires."""
    if risk is None or not found.converged:
        return found
    least = least_confidence(risk)
    known = found.confidence if isinstance(found.diagnostics, Evidence) else None
    if known is not None and known >= least:
        return found
    why = f"the confidence is {'unknown' if known is None else format(known, '.3f')}, a risk of {risk:g} requires {least:.3f}"
    return found.rejected(Verdict(Outcome.UNCERTAIN, why, found.confidence))


def within_limits(found: Localization, config: Any) -> Localization:
    """Return the answer, rejected as ``uncertain`` if it does not keep the ``tolerance`` of ``AutoConfig`` or the ``risk`` of the settings.

    It keeps the tolerance if its covariance puts four fifths of the probability within it, and within 0.05 radians.
    """
    tolerance = config.tolerance if isinstance(config, AutoConfig) else None
    if tolerance is not None and found.converged:
        one, mass = torch.ones(1, dtype=torch.float64), 0.0
        if found.covariance is not None:
            mass = mass_within(one, torch.zeros((1, 6)).double(), found.covariance[None], tolerance)
        if mass < 0.8:
            why = f"the position is right within {tolerance:g} with a probability of {mass:.0%}, expected at least 80%"
            found = found.rejected(Verdict(Outcome.UNCERTAIN, why, found.confidence))
    return within_risk(found, getattr(config, "risk", None))


AUTO = Method(
    auto,
    AutoConfig,
    needs_start=False,
    uses_landmarks=True,
    summary="landmarks, then search on the baked surface by depth or colour; no start needed",
)
