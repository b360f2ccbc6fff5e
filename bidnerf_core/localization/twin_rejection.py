"""Poses in a scene that repeats itself: a start or renderings tell two places apart, or the pose is rejected."""

from __future__ import annotations

import math
from dataclasses import replace

from bidnerf_core.frames.frame import View
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.acceptance import landmark_verdict
from bidnerf_core.localization.by_landmarks import LandmarkAnswer, corrected, fused_answer
from bidnerf_core.localization.landmarks.landmark_pose import LandmarkPose, Twin
from bidnerf_core.localization.landmarks.propose import confirm
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.rendered_evidence import log_odds_by_rendering
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.search.matching import LandmarkMatcher

TWIN_LOG_ODDS = 10.0
"""Log odds beyond which renderings decide between two places.

Even at exact copies the odds are not 0, since keypoints determine the pose at one of them better.
"""
FITTING_STEPS = 5
"""Number of steps to the poses near both places that suit the images best."""
NEARER = 0.5
"""Ratio of the motions from a start to one place and to the other one below which the start decides."""
NEARLY_AS_MANY = 0.8
"""Share of the correspondences that match at another place, at and above which their number alone does not decide."""


def between_twins(
    problem: Problem,
    matcher: LandmarkMatcher,
    answer: LandmarkAnswer,
    start: SE3 | None,
    rays: int,
    seed: int,
) -> LandmarkAnswer:
    """Return an answer as it is, the one at its twin if that is right, or a rejection if nothing distinguishes the two.

    A ``start`` that is far nearer to one of them decides. Otherwise renderings of both are compared, unless ``rays`` is 0.
    """
    found = answer.found
    if found.twin is None or not answer.verdict.accepted:
        return answer
    odds = _log_odds(problem, found, found.twin, start, rays, seed)
    if _is_distinguished(odds, found.twin):
        return answer
    if odds < -TWIN_LOG_ODDS:
        there = _at_twin(problem, matcher, found, found.twin)
        verdict = None if there is None else landmark_verdict(there)
        if there is not None and verdict is not None and verdict.accepted:
            return fused_answer(problem, there, verdict, rays, seed)
    return replace(answer, verdict=_rejection(found.twin), confidence=None, terms=(), left_out="")


def twin_rejection(
    problem: Problem, found: LandmarkPose, start: SE3 | None, rays: int, seed: int
) -> Verdict | None:
    """Return a rejection of a pose whose twin fits about as well, else None; ``start`` and ``rays`` as in ``between_twins``."""
    if found.twin is None or _is_distinguished(
        _log_odds(problem, found, found.twin, start, rays, seed), found.twin
    ):
        return None
    return _rejection(found.twin)


def _at_twin(
    problem: Problem, matcher: LandmarkMatcher, found: LandmarkPose, twin: Twin
) -> LandmarkPose | None:
    """Return the pose at the twin."""
    seen = _views_seen_by(problem, found)
    there = confirm(matcher, seen, twin.T_world_rig, rival=found.T_world_camera).pose
    if there is None:
        return None
    if found.intrinsics_of(problem.views[-1].frame.intrinsics) is None:
        return there
    if there.changes_camera:  # of two corrections, one after the other, nothing keeps account
        return None
    return replace(
        there, calibration=found.calibration, calibration_deviations=found.calibration_deviations,
        intrinsics=found.intrinsics,
    )  # fmt: skip


def _views_seen_by(problem: Problem, found: LandmarkPose) -> list[View]:
    """Return the views with the intrinsics of a pose."""
    cameras = [view.frame.intrinsics for view in problem.views]
    return [
        replace(view, frame=replace(view.frame, intrinsics=found.intrinsics_of(camera) or camera))
        for view, camera in zip(problem.views, cameras, strict=True)
    ]


def _rejection(twin: Twin) -> Verdict:
    many = f"{min(twin.share, 1):.0%} as many"
    return Verdict(
        Outcome.AMBIGUOUS, f"{many} landmarks match at another place, and nothing tells the two apart"
    )


def _is_distinguished(log_odds: float, twin: Twin) -> bool:
    """Return whether a pose is distinguished from its twin: without other evidence, by clearly more landmarks."""
    return log_odds > TWIN_LOG_ODDS or (log_odds == 0 and twin.share < NEARLY_AS_MANY)


def _log_odds(
    problem: Problem, found: LandmarkPose, twin: Twin, start: SE3 | None, rays: int, seed: int
) -> float:
    """Return the log odds of the pose against its twin; 0 without evidence."""
    if start is not None:
        here, there = (_motion(start, T, found.distance) for T in (found.T_world_camera, twin.T_world_rig))
        if here < NEARER * there or there < NEARER * here:
            return math.inf if here < there else -math.inf
    if not rays:
        return 0.0
    one = corrected(problem, found)
    return log_odds_by_rendering(one, replace(one, start=twin.T_world_rig), seed, FITTING_STEPS)


def _motion(start: SE3, T: SE3, distance: float) -> float:
    """Return about how far (metres) what is seen at a ``distance`` (metres) moves between two poses."""
    update = (start.to("cpu", T.translation.dtype).inverse() @ T).log()
    return float(update[:3].norm() + distance * update[3:].norm())
