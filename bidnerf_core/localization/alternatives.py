"""Other explanations of an image than the pose that was found, and the decision between them.

Errors of a camera's intrinsics leave an image's keypoints matched to the same landmarks, and ``landmarks/hypotheses`` weighs
them. Here are explanations with other matches or from another side: the image shows the scene as in a mirror, it shows another
place that looks the same, or a plane from its other side of the line of sight. What is known for free comes first: a start, and
how many landmarks match. Where this leaves it open, what the field renders for both is compared. Keypoints are few and in a few
places; thousands of rendered rays cover the whole image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.frames.frame import View
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.acceptance import LandmarkThresholds
from bidnerf_core.localization.beyond_chance import log_odds
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.depth_scale import corrected
from bidnerf_core.localization.landmarks.chance import DECISIVE, log_odds_of_share, probability_of
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.localization.landmarks.mirrored import mirror_evidence, mirror_image
from bidnerf_core.localization.landmarks.pose import LandmarkPose, Rival
from bidnerf_core.localization.landmarks.propose import confirm, propose
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.recording import ComparedExplanation, current_record
from bidnerf_core.localization.refinement import take_few_steps
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.settings import ColourSettings, RefinementSettings, RefinementStage
from bidnerf_core.localization.solvers.pivots import pivot

BY_START = 6.0
"""Log odds for each factor e between the motions from a start: in six dimensions, a normal distribution of unknown width about
the start has a density that falls with their sixth power.
"""
UNMISTAKABLE = -150.0
"""Logarithm of the number of false alarms below which an image is not compared with its mirror image."""
SIGNIFICANT = -20.0
"""Largest logarithm of an image's number of false alarms with which that of its mirror image is compared: a few chance matches of
the mirror image say nothing about an image with even fewer.
"""
UNTOLD = 0.5
"""Log odds below which two explanations are called equally likely: probabilities of 38 % to 62 %."""
AT_COPIES = 6.0
"""Log odds by renderings that errors of the two poses alone may bring about, even at exact copies of a place."""
COMPARED_RAYS = 8192
"""Number of rays on which two explanations are compared; fewer if fewer pixels are not hidden."""
FITTED = RefinementStage(steps=5, rays=1024)
"""The steps to the pose that suits an explanation best. The comparison draws other rays."""
NOISIEST = 0.15
"""Colour noise of a field on its own training images above which it provides no evidence: it has hardly been trained."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """Another explanation of images."""

    log_odds: float  # of the pose that was found against it, by what is known for free
    reason: str
    # Returns the images and, as the start, the pose that explain them so, or None if there is no such pose.
    problem: Callable[[], Problem | None]
    rival: Rival | None = None  # the other pose; None for a mirror image


@dataclass(frozen=True, eq=False)
class Decision:
    """What other explanations mean for a pose."""

    rejection: Verdict | None = None  # None: it stays
    better: Rival | None = None  # the pose that is right in its place


def decide(problem: Problem, T: SE3, found: LandmarkPose | None, rays: int, seed: int) -> Decision:
    """Decide between a pose of a problem, ``T``, and all other explanations.

    ``found``: what landmarks say about that pose, if they match there. The start of ``problem`` is what was known before. Where
    that leaves it open, renderings of both explanations are compared, unless ``rays`` is 0.
    """
    here = replace(problem if found is None else corrected(problem, found), start=T)
    for other in _alternatives(problem, here, found, seed):
        odds = other.log_odds
        there = other.problem() if rays and abs(odds) < DECISIVE else None
        if there is not None:
            same = replace(here, views=here.views[-len(there.views) :])
            rendered = log_odds_by_rendering(same, there, seed)
            odds += math.copysign(max(0.0, abs(rendered) - AT_COPIES), rendered)
        if (record := current_record()) is not None:
            T_other = None if other.rival is None else other.rival.T_world_rig
            record.explanations.append(ComparedExplanation(other.reason, odds, T_other))
        if odds < -DECISIVE and other.rival is None:
            return Decision(Verdict(Outcome.MIRRORED, other.reason))
        if odds < DECISIVE:
            better = other.rival if odds < -DECISIVE else None
            return Decision(Verdict(Outcome.AMBIGUOUS, f"{other.reason}, and {_in_words(odds)}"), better)
    return Decision()


def _in_words(odds: float) -> str:
    """Return what the log odds of a pose say about the other explanation."""
    if abs(odds) < UNTOLD:
        return "nothing tells the two apart"
    if odds < -DECISIVE:
        return "the other one is far likelier"
    return f"the other one is {probability_of(-odds):.0%} likely"


def pose_at(
    problem: Problem, matcher: LandmarkMatcher, found: LandmarkPose, rival: Rival
) -> LandmarkPose | None:
    """Return the pose by landmarks at a rival of ``found``, or None if too few match there or correct the camera once more."""
    cameras = [view.frame.intrinsics for view in problem.views]
    seen = [
        replace(view, frame=replace(view.frame, intrinsics=found.intrinsics_of(camera) or camera))
        for view, camera in zip(problem.views, cameras, strict=True)
    ]
    there = confirm(matcher, seen, rival.T_world_rig, rival=found.T_world_camera).pose
    if there is None or found.intrinsics_of(cameras[-1]) is None:
        return there
    if there.changes_camera:  # of two corrections, one after the other, nothing keeps account
        return None
    return replace(
        there, calibration=found.calibration, calibration_deviations=found.calibration_deviations,
        intrinsics=found.intrinsics,
    )  # fmt: skip


def _alternatives(
    problem: Problem, here: Problem, found: LandmarkPose | None, seed: int
) -> Iterator[Alternative]:
    log10_nfa = 0.0 if found is None else found.log10_nfa
    if problem.matcher is not None and log10_nfa > UNMISTAKABLE:
        yield _mirror(problem, problem.matcher, log10_nfa, seed)
    if found is None:
        return
    for rival in found.rivals:
        T, there = found.T_world_camera, rival.T_world_rig
        apart = float((there.translation - T.translation).norm())
        if apart <= LandmarkThresholds().precision * found.distance:
            continue  # the answer is as right as it has to be
        odds = rival.log_odds
        if problem.start is not None:
            odds += _log_odds_by_start(problem.start, T, there, found.distance)
        yield Alternative(odds, rival.reason, partial(replace, here, start=there), rival)


def _mirror(problem: Problem, matcher: LandmarkMatcher, log10_nfa: float, seed: int) -> Alternative:
    """Return the mirror image of the last view; ``log10_nfa``: of the pose of the view itself."""
    view = View(mirror_image(problem.views[-1].frame), SE3.identity())
    agreeing, mirror_nfa = mirror_evidence(matcher, view, seed)

    def mirrored() -> Problem | None:
        found = propose(matcher, [view], seed=seed)
        return None if found is None else corrected(replace(problem, views=(view,)), found)

    odds = log_odds_of_share(mirror_nfa / min(log10_nfa, SIGNIFICANT))
    return Alternative(odds, f"{agreeing} landmarks agree with the mirror image", mirrored)


def _log_odds_by_start(start: SE3, T: SE3, rival: SE3, distance: float) -> float:
    """Return the log odds of a pose against its rival by how far (metres) what is seen at a ``distance`` (metres) moves from a start."""

    def motion(T: SE3) -> float:
        update = (start.to("cpu", T.translation.dtype).inverse() @ T).log()
        return max(float(update[:3].norm() + distance * update[3:].norm()), 1e-9)

    return BY_START * math.log(motion(rival) / motion(T))


def log_odds_by_rendering(one: Problem, other: Problem, seed: int, steps: int = FITTED.steps) -> float:
    """Return the log odds, by rendered colours alone, of ``one`` against ``other``.

    Both hold images of the same size with intrinsics and, as the start, the pose found with them; ``steps`` steps lead from
    there to the pose that suits them best. Returns 0 where the field is too noisy or renders values that are not finite.
    """
    if one.colour_noise is not None and one.colour_noise > NOISIEST:
        return 0.0
    stage = replace(FITTED, steps=steps)
    rival = _ray_costs(other, stage, seed)
    return float(log_odds(rival[None], _ray_costs(one, stage, seed))[0])


def _ray_costs(problem: Problem, stage: RefinementStage, seed: int) -> Float[Tensor, "n"]:
    """Return the cost of each ray from the pose near the start that suits the images best."""
    problem = problem.without_depth()
    assert problem.start is not None
    settings = RenderedCostSettings(ColourSettings(), None, RefinementSettings(exposure=True))
    generator = Generator().manual_seed(seed)
    T = take_few_steps(problem, problem.start, stage, settings, generator).poses[-1]
    compared = replace(stage, rays=min(COMPARED_RAYS, _visible_pixels(problem)))
    cost = settings.drawn(
        problem.on_device(), compared, pivot("scene", problem).to(problem.device), generator
    )
    return cost.residuals(T[None], derivatives=False).ray_costs()[0]


def _visible_pixels(problem: Problem) -> int:
    sizes = [view.frame.intrinsics.width * view.frame.intrinsics.height for view in problem.views]
    hidden = [0 if view.frame.hidden is None else int(view.frame.hidden.sum()) for view in problem.views]
    return max(1, sum(sizes) - sum(hidden))
