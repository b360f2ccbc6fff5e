"""Method ``auto``: find the pose with or without a start, from all available measurements, and decide whether to trust it.

If the map has landmarks, they are matched first, and their pose is fused with measured depth and rendered rays. If that pose is
not accepted, the surface is searched: measured points are aligned with it if there is enough depth; otherwise, the images are
compared with its renderings. In a map without a surface, ``auto`` needs a start, from which it descends as ``bid`` does.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

from bidnerf_core.depth import find_depth_sensor
from bidnerf_core.errors import InputError
from bidnerf_core.localization.acceptance import (
    LandmarkDiagnostics,
    LandmarkThresholds,
    landmark_verdict,
    without_ambiguous_intrinsics,
)
from bidnerf_core.localization.alternatives import decide
from bidnerf_core.localization.by_blurred_image import refined_if_blurred
from bidnerf_core.localization.by_colour import without_the_imprecise
from bidnerf_core.localization.by_landmarks import (
    MOSTLY_ON_SURFACE,
    LandmarkAnswer,
    answer_by_landmarks,
    fused_answer,
    is_sharp,
    localization_by_landmarks,
)
from bidnerf_core.localization.by_surface import localize_by_depth, localize_by_images
from bidnerf_core.localization.confidence import TRUSTED
from bidnerf_core.localization.landmarks.matching import LandmarkMatcher
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.landmarks.propose import confirm
from bidnerf_core.localization.methods import BidConfig, Method, SharedSettings, bid
from bidnerf_core.localization.occluders import nearest_piece
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.recording import current_record
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.risk import within_risk
from bidnerf_core.localization.settings import LEAST_POINTS, AutoConfig

FINAL = (Outcome.MISCALIBRATED, Outcome.MIRRORED)
"""Outcomes of a pose by landmarks that no other measurement can correct: with wrong intrinsics, aligning points with the surface
fails too.
"""
IN_FRONT = 0.9
"""Minimum fraction of an occluder's points that must lie in front of the surface."""
MANY_LANDMARKS = 500
"""Minimum number of landmarks of a textured scene."""
LEAST_SUPPORT = 0.5
"""Minimum confidence for landmarks to support a pose accepted on the surface."""


def auto(problem: Problem, config: AutoConfig, seed: int = 0) -> Localization:
    """Find the pose by landmarks, or else by depth or colour on the surface, or else by descent from a start.

    If the pose is rejected, or doubtful because of an occluder, the image is tried again without the nearest measured object,
    which may hide the scene. Raises ``InputError`` if the map has no baked surface, landmarks give no pose, and there is no
    start.
    """
    problem = replace(problem, sensor=find_depth_sensor(config.depth_sensor))
    found = _found_behind_occluders(problem, config, seed)
    return found if config.risk is None else within_risk(found, config.risk)


def _found_behind_occluders(problem: Problem, config: AutoConfig, seed: int) -> Localization:
    found = _localized(problem, config, seed)
    if _is_settled(found) or found.outcome in FINAL or problem.surface is None:
        return found
    occluder = nearest_piece(problem)
    if occluder is None:
        return found
    if found.converged and occluder.share_in_front(problem.surface, found.T_world_camera) < IN_FRONT:
        return found
    rest = _localized(occluder.rest, config, seed)
    seconds = found.seconds + rest.seconds
    if not rest.converged or occluder.share_in_front(problem.surface, rest.T_world_camera) < IN_FRONT:
        return replace(found, seconds=seconds)
    hidden = f"without the nearest {occluder.share:.0%} of the measured points, which are on an occluder"
    return replace(rest, reason=f"{rest.reason}, {hidden}", seconds=seconds)


@dataclass(frozen=True, eq=False)
class _Proposal:
    """A pose that may be the answer."""

    found: Localization
    near: LandmarkPose | None = None  # pose by the landmarks that match near a pose found by other means
    decided: bool = False  # whether it was compared with alternative explanations


def _localized(problem: Problem, config: AutoConfig, seed: int) -> Localization:
    """Return the best pose, rejected if an alternative explanation of the images may be right."""
    began, rays = time.perf_counter(), config.fused_rays
    proposal = _proposed(problem, config, seed, began)
    before = without_ambiguous_intrinsics(proposal.found, problem)
    found = refined_if_blurred(problem, before) if rays else before
    decided = proposal.decided and before.converged
    if found.converged and config.landmarks and not decided:
        why = decide(problem, found.T_world_camera, proposal.near, rays, seed).rejection
        found = found if why is None else found.rejected(why)
    return replace(found, seconds=time.perf_counter() - began)


def _proposed(problem: Problem, config: AutoConfig, seed: int, began: float) -> _Proposal:
    answer, matcher = None, problem.matcher if config.landmarks else None
    if matcher is not None:
        answer = answer_by_landmarks(problem, matcher, config.fused_rays, seed)
    has_points = _measured_points(problem) >= LEAST_POINTS
    by_landmarks = None
    if answer is not None:
        by_landmarks = _Proposal(localization_by_landmarks(problem, answer, began), decided=True)
        if _is_final(answer, has_points):
            return by_landmarks
        if problem.start is None:
            problem = replace(problem, start=answer.T)  # one more place to look
    if problem.surface is None:
        found = _descended(problem, seed, "the map has no surface ('bidnerf bake' makes one)")
        if matcher is None or not found.converged:
            return _Proposal(found)
        return _Proposal(found, confirm(matcher, problem.views, found.T_world_camera, seek_rivals=True).pose)
    if has_points:
        found = localize_by_depth(problem, problem.surface, config, seed)
    else:
        hopeless = _unrecognised(problem) if matcher is not None and _is_hopeless(problem) else None
        found = localize_by_images(problem, problem.surface, config, seed, hopeless)
        typical = 0.0 if matcher is None else matcher.landmarks.trial.translation
        found = without_the_imprecise(found, typical)
    if matcher is None:
        return _Proposal(found if problem.matcher is not None else _with_hint_at_landmarks(found))
    proposal = _compared_with_landmarks(found, problem, matcher, config, seed, began)
    is_unsure = answer is not None and answer.verdict.outcome in (Outcome.IMPRECISE, Outcome.UNCERTAIN)
    if by_landmarks is not None and is_unsure and proposal.found.outcome is Outcome.TOO_FEW_MATCHES:
        return by_landmarks
    return proposal


def _is_hopeless(problem: Problem) -> bool:
    """Return whether an image without recognised landmarks cannot be localized, as the scene is textured but the field blurred."""
    textured = problem.matcher is not None and len(problem.matcher.landmarks) >= MANY_LANDMARKS
    return textured and not is_sharp(problem)


def _unrecognised(problem: Problem) -> Verdict:
    causes = "the image may show another place, or be too dark, too blurred or taken from too far away"
    focal = ", or its focal length may be too far off" if problem.focal_is_approximate else ""
    why = f"too few landmarks were recognised, and the field is not sharp enough to compare images with it: {causes}{focal}"
    return Verdict(Outcome.TOO_FEW_MATCHES, why)


def _with_hint_at_landmarks(found: Localization) -> Localization:
    """Add a hint to a rejected answer that the map has no landmarks, if they might have given a pose."""
    if found.converged or found.outcome is Outcome.UNDETERMINED:
        return found
    return replace(found, reason=f"{found.reason}; the map has no landmarks ('bidnerf bake' makes them)")


def _is_settled(found: Localization) -> bool:
    """Return whether a pose is accepted and shows no sign of an occluder."""
    said = found.diagnostics
    if not found.converged or not isinstance(said, LandmarkDiagnostics) or said.on_surface is None:
        return found.converged
    return (found.confidence or 0.0) >= TRUSTED and said.on_surface >= MOSTLY_ON_SURFACE


def _is_final(answer: LandmarkAnswer, has_points: bool) -> bool:
    """Return whether the surface cannot improve the pose by landmarks.

    Colours do not determine a position that landmarks leave imprecise because the intrinsics are unknown.
    """
    if answer.has_rival:
        return True  # the surface is assumed to look the same there, too
    outcome = answer.verdict.outcome
    unknown_camera = outcome is Outcome.IMPRECISE and answer.found.estimates_calibration
    if outcome is Outcome.UNCERTAIN or unknown_camera:
        return not has_points
    return outcome is Outcome.CONVERGED or outcome in FINAL


def _compared_with_landmarks(
    found: Localization,
    problem: Problem,
    matcher: LandmarkMatcher,
    config: AutoConfig,
    seed: int,
    began: float,
) -> _Proposal:
    """Refine a pose found on the surface by the landmarks that match there, or reject it if too few of the visible ones match.

    Landmarks whose own pose is not accepted only confirm an accepted pose, and do not move it.
    """
    near = confirm(matcher, problem.views, found.T_world_camera, seek_rivals=True)
    if near.pose is not None and (record := current_record()) is not None:
        record.landmarks.append(near.pose)
    # Matches are no accident near a pose found by other means.
    verdict = (
        None if near.pose is None else landmark_verdict(near.pose, LandmarkThresholds(log10_nfa=math.inf))
    )
    if near.pose is not None and verdict is not None and verdict.accepted:
        answer = fused_answer(problem, near.pose, verdict, config.fused_rays, seed, searched=False)
        supported = found.converged and (answer.verdict.confidence or 0.0) >= LEAST_SUPPORT
        if supported and not answer.verdict.accepted:
            return _Proposal(found, near.pose)  # they confirm the pose, but are too few to move it
        refined = localization_by_landmarks(problem, answer, began)
        return _Proposal(replace(refined, reason=f"found on the surface; {refined.reason}"), near.pose)
    if found.converged and near.contradicts:
        why = f"{near.matches} landmarks match, {near.chance:.0f} by chance, of {near.visible} that should be visible"
        found = found.rejected(Verdict(Outcome.TOO_FEW_MATCHES, why))
    elif found.converged and verdict is not None and _is_misled(verdict, problem):
        found = found.rejected(verdict)
    return _Proposal(found, near.pose)


def _is_misled(near: Verdict, problem: Problem) -> bool:
    """Return whether landmarks contradict the intrinsics of a pose by colour, as wrong intrinsics fit at a wrong pose."""
    return near.outcome is Outcome.MISCALIBRATED and _measured_points(problem) < LEAST_POINTS


def _measured_points(problem: Problem) -> int:
    images = [view.frame.depth for view in problem.views if view.frame.depth is not None]
    pixels = sum(int(((depth > 0) & depth.isfinite()).sum()) for depth in images)
    return pixels + (0 if problem.depth_rays is None else len(problem.depth_rays))


def _descended(problem: Problem, seed: int, why: str) -> Localization:
    if problem.start is None:
        raise InputError("method 'auto' then needs a start; give one", where=why)
    found = bid(problem, BidConfig(), seed)
    return replace(found, reason=f"{why}; {found.reason}")


AUTO = Method(
    auto,
    AutoConfig,
    needs_start=False,
    uses_landmarks=True,
    shared=lambda config: SharedSettings(
        config.landmarks, config.depth_sensor, config.by_colour, config.fused_rays, config.risk
    ),
    summary="landmarks, then search on the baked surface by depth or colour; no start needed",
)
