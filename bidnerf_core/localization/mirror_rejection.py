"""Rejection of mirrored images: landmarks and, where these recognise the mirror image, renderings decide."""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.frames.frame import View
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.by_landmarks import corrected
from bidnerf_core.localization.landmarks.propose import propose
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.rendered_evidence import log_odds_by_rendering
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.mirrored import SUSPICIOUS, mirror_evidence, mirror_image

MIRROR_LOG_ODDS = 3.0
"""Log odds beyond which renderings decide between an image and its mirror image."""
HARDLY_MATCHED = -60.0
"""Logarithm of the number of false alarms above which renderings are compared even if the mirror image is not recognised."""


def mirror_rejection(
    problem: Problem, matcher: LandmarkMatcher, log10_nfa: float, rays: int, seed: int
) -> Verdict | None:
    """Return a rejection of the start of ``problem`` if the mirror image fits as well or better, else None.

    ``log10_nfa``: logarithm of the number of false alarms of the pose. Where landmarks recognise the mirror image, or hardly
    recognise the image, renderings of both decide, unless ``rays`` is 0.
    """
    if log10_nfa < SUSPICIOUS:
        return None
    rejection = mirror_evidence(matcher, problem.views, seed=seed).rejection(log10_nfa)
    if not rays or (rejection is None and log10_nfa < HARDLY_MATCHED):
        return rejection
    last = View(mirror_image(problem.views[-1].frame), SE3.identity())
    mirrored = propose(matcher, [last], seed=seed)
    if mirrored is None:
        return rejection
    image, mirror = replace(problem, views=problem.views[-1:]), replace(problem, views=(last,))
    odds = log_odds_by_rendering(image, corrected(mirror, mirrored), seed)
    if odds > MIRROR_LOG_ODDS:
        return None
    if odds < -MIRROR_LOG_ODDS and rejection is None:
        return Verdict(Outcome.MIRRORED, "renderings agree better with the mirror image")
    return rejection
