"""Alternative explanations of an image, and the decision between them and the pose that was found.

Wrong intrinsics leave keypoints matched to the same landmarks, and are handled by ``landmarks/hypotheses``. The explanations
here have other matches or another viewpoint: the image is mirrored, it shows another place that looks the same, or the pose is
the second solution of a planar scene. The start and the number of matching landmarks, which cost nothing, are used first. If
they do not decide, renderings of both explanations are compared, because thousands of rays cover the whole image, whereas
keypoints are few and clustered.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.camera import Orientation
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.acceptance import LandmarkThresholds
from bidnerf_core.localization.costs.rendered import RenderedCostSettings
from bidnerf_core.localization.depth_scale import at_pose
from bidnerf_core.localization.landmarks.chance import CONVINCING, DECISIVE, log_odds_of_share, probability_of
from bidnerf_core.localization.landmarks.consensus import sample_consensus
from bidnerf_core.localization.landmarks.correspondences import query_images
from bidnerf_core.localization.landmarks.evidence import log10_agreement
from bidnerf_core.localization.landmarks.matching import STRONGEST, LandmarkMatcher, unguided_matches
from bidnerf_core.localization.landmarks.pose import LandmarkPose, Rival
from bidnerf_core.localization.landmarks.propose import confirm, propose
from bidnerf_core.localization.landmarks.query import LandmarkQuery
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.recording import ComparedExplanation, current_record
from bidnerf_core.localization.refinement import take_few_steps
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.settings import ColourSettings, RefinementSettings, RefinementStage
from bidnerf_core.localization.solvers.pivots import pivot
from bidnerf_core.localization.support import log_odds
from bidnerf_core.mapping import FIXED

UNMISTAKABLE = -150.0
"""Log10 of the number of false alarms below which an image is not compared with its mirror image."""
AT_COPIES = 6.0
"""Log odds by rendering that errors of the two poses alone can produce, even at exact copies of a place."""
COMPARED_RAYS = 8192
"""Number of rays on which two explanations are compared; fewer if fewer pixels are visible."""
FITTED = RefinementStage(steps=5, rays=1024)
"""The steps to the best pose for an explanation. The comparison draws other rays."""
NOISIEST = 0.15
"""Colour noise of a field on its training images above which it provides no evidence, as it is hardly trained."""


@dataclass(frozen=True, eq=False)
class Alternative:
    """An alternative explanation of the images."""

    log_odds: float  # of the found pose against it, before rendering
    reason: str
    # Returns the images and, as the start, the pose of this explanation; None if there is no such pose.
    problem: Callable[[], Problem | None]
    rival: Rival | None = None  # the other pose; None for a mirror image


@dataclass(frozen=True, eq=False)
class Decision:
    """The result of comparing a pose with its alternatives."""

    rejection: Verdict | None = None  # None: the pose is kept
    better: Rival | None = None  # the pose that is right instead


def decide(problem: Problem, T: SE3, found: LandmarkPose | None, rays: int, seed: int) -> Decision:
    """Decide whether to keep the pose ``T`` (T_world_K, see ``Problem``) or reject it in favour of an alternative explanation.

    ``found`` is the pose estimated from landmarks, or None. The log odds of each alternative come first from the numbers of
    landmark inliers and from ``problem.start``, which serves as a prior. If they are inconclusive, renderings at both poses
    are compared, unless ``rays`` is 0.
    """
    here = replace(problem if found is None else at_pose(problem, found), start=T)
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
    """Return a phrase for the other explanation's probability, from the log odds of the pose against it."""
    if odds < -DECISIVE:
        return "the other one is far likelier"
    return f"the other one is {probability_of(-odds):.0%} likely"


def pose_at(
    problem: Problem, matcher: LandmarkMatcher, found: LandmarkPose, rival: Rival
) -> LandmarkPose | None:
    """Return the pose by landmarks at a rival of ``found``; None if too few match or the camera is corrected once more."""
    cameras = [view.frame.intrinsics for view in problem.views]
    seen = [
        replace(view, frame=view.frame.replace(intrinsics=found.intrinsics_of(camera) or camera))
        for view, camera in zip(problem.views, cameras, strict=True)
    ]
    there = confirm(matcher, seen, rival.T_world_rig, rival=found.T_world_camera).pose
    if there is None or found.intrinsics_of(cameras[-1]) is None:
        return there
    if there.changes_camera:  # successive corrections are not composed
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
            continue  # the pose is accurate enough either way
        odds = rival.log_odds
        if problem.start is not None:
            odds += _log_odds_by_start(problem.start, T, there, found.distance)
        yield Alternative(odds, rival.reason, partial(replace, here, start=there), rival)


def _mirror(problem: Problem, matcher: LandmarkMatcher, log10_nfa: float, seed: int) -> Alternative:
    """Return the alternative that the last view is mirrored; ``log10_nfa`` is that of the pose of the view itself."""
    view = View(mirror_image(problem.views[-1].frame), SE3.identity())
    agreeing, mirror_nfa = mirror_evidence(matcher, view, seed)

    def mirrored() -> Problem | None:
        found = propose(matcher, [view], seed=seed)
        return None if found is None else at_pose(replace(problem, views=(view,)), found)

    # A few chance matches of the mirror image are no evidence against an image with even fewer.
    odds = log_odds_of_share(mirror_nfa / min(log10_nfa, CONVINCING))
    return Alternative(odds, f"the mirror image has {agreeing} landmark inliers", mirrored)


def _log_odds_by_start(start: SE3, T: SE3, rival: SE3, distance: float) -> float:
    """Return the log odds of a pose against its rival by their distances from a start, for a scene at ``distance`` (metres).

    In six dimensions, the density of a normal distribution of unknown width about the start falls with the sixth power of the
    distance.
    """

    def motion(T: SE3) -> float:
        update = (start.to("cpu", T.translation.dtype).inverse() @ T).log()
        return max(float(update[:3].norm() + distance * update[3:].norm()), 1e-9)

    return 6 * math.log(motion(rival) / motion(T))


def log_odds_by_rendering(one: Problem, other: Problem, seed: int, steps: int = FITTED.steps) -> float:
    """Return the log odds of ``one`` against ``other`` by rendered colours alone.

    Both contain images of the same size with intrinsics and, as the start, the pose found with them, which is first refined by
    ``steps`` steps. Returns 0 if the field is too noisy or renders non-finite values.
    """
    if one.colour_noise is not None and one.colour_noise > NOISIEST:
        return 0.0
    stage = replace(FITTED, steps=steps)
    rival = _ray_costs(other, stage, seed)
    return float(log_odds(rival[None], _ray_costs(one, stage, seed))[0])


def _ray_costs(problem: Problem, stage: RefinementStage, seed: int) -> Float[Tensor, "n"]:
    """Return the cost of each ray at the pose near the start that fits the images best."""
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


def mirror_evidence(matcher: LandmarkMatcher, view: View, seed: int = 0) -> tuple[int, float]:
    """Match a view of the mirror image with the map.

    Returns the number of landmark inliers, and log10 of the number of false alarms.
    """
    query = LandmarkQuery(query_images([view], matcher.features), matcher.landmarks, FIXED)
    matches = unguided_matches(query.images, matcher, STRONGEST)
    found = sample_consensus(query.observed(matches), matches.view, query.threshold, seed)
    agreeing = 0 if found is None else int(found.inliers.sum())
    return agreeing, log10_agreement(query, matches, agreeing)


def mirror_image(frame: Frame) -> Frame:
    """Return the mirror image of a frame (left and right swapped), without depth."""
    swap = Orientation(mirrors_columns=True)
    alpha, hidden = (None if image is None else swap.upright(image) for image in (frame.alpha, frame.hidden))
    camera = frame.intrinsics.upright(swap)
    return replace(
        frame, rgb=swap.upright(frame.rgb), depth=None, alpha=alpha, hidden=hidden, intrinsics=camera
    )
