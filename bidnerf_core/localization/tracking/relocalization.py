"""Relocalization of a lost tracker, within a limited time per frame."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.auto import MANY_LANDMARKS
from bidnerf_core.localization.by_landmarks import answer_by_landmarks, localization_by_landmarks
from bidnerf_core.localization.by_surface import is_blank
from bidnerf_core.localization.localizer import Localizer
from bidnerf_core.localization.problem import Problem, SceneMap
from bidnerf_core.localization.result import Localization
from bidnerf_core.localization.risk import within_risk
from bidnerf_core.localization.settings import LEAST_POINTS

FIRST_FULL_SEARCH = 4
"""The number of lost frames after which the whole surface is searched, and again each time that number has doubled."""
LONG_WAIT = 0.25
"""Interval without a search, in seconds, after which every frame is searched, as such frames arrive slowly enough."""


def search_due(localizer: Localizer, frame: Frame, lost: int, patience: int, waited: float = 0.0) -> bool:
    """Return whether to search for the pose of a frame instead of skipping it to save time.

    In maps with landmarks, the first ``patience`` frames after a loss are searched, then every second one, or every one if
    ``waited``, the time (seconds) without a search, is long. ``lost`` is as for ``relocalized``.
    """
    if not is_searchable(frame):
        return False
    if localizer.matches_landmarks:
        return lost <= patience or lost % 2 == 0 or waited >= LONG_WAIT
    return lost == 0 or _due(lost, 1)


def relocalized(
    localizer: Localizer, frame: Frame, predicted: SE3 | None, lost: int, seed: int
) -> Localization | None:
    """Search for the pose of a frame for which ``search_due`` holds; None if none was found.

    If the map has landmarks, they are matched first. The search of the whole surface, which takes longer, runs at increasing
    intervals; it is the only one in maps without landmarks. ``lost`` is the number of searchable frames since the last accepted
    pose, 0 at the beginning of a sequence.
    """
    if localizer.matches_landmarks:
        problem = localizer.problem(frame)
        near = predicted if lost <= FIRST_FULL_SEARCH else None  # later predictions have drifted
        found = _recognised(problem, near, localizer.shared.rays, seed)
        if found is not None and localizer.shared.risk is not None:
            found = within_risk(found, localizer.shared.risk)
        if (found is not None and found.converged) or not _searched(localizer, frame, lost):
            return found
        return localizer.solved(replace(problem, start=predicted), seed)
    try:
        return localizer.solved(localizer.problem(frame, predicted), seed)
    except InputError:
        if lost:  # the sequence has begun, so the frame is at fault, not the map or the settings
            return None
        raise


def _recognised(problem: Problem, near: SE3 | None, rays: int, seed: int) -> Localization | None:
    """Return the pose by landmarks, with renderings only if alternatives are undecided, and preferring rivals close to ``near``."""
    assert problem.matcher is not None
    began = time.perf_counter()
    answer = answer_by_landmarks(replace(problem, start=near), problem.matcher, rays, seed, fused=False)
    return None if answer is None else localization_by_landmarks(problem, answer, began)


def typical_error(localizer: Localizer) -> float:
    """Return the median position error (metres) of the map's own images; 0 if unknown."""
    return 0.0 if localizer.matcher is None else localizer.matcher.landmarks.trial.translation


def scene_extent(scene: SceneMap) -> float:
    """Return the size of the scene (metres)."""
    if scene.surface is not None:
        return scene.surface.extent
    corners = torch.tensor([scene.bounds.lower, scene.bounds.upper])
    return float(torch.linalg.vector_norm(corners[1] - corners[0]))


def is_searchable(frame: Frame) -> bool:
    """Return whether the frame shows anything recognisable."""
    return has_points(frame) or not is_blank(frame)


def has_points(frame: Frame) -> bool:
    """Return whether the frame has enough measured depth for the shape of the scene to be recognised."""
    return frame.depth is not None and int((frame.depth > 0).sum()) >= LEAST_POINTS


def _searched(localizer: Localizer, frame: Frame, lost: int) -> bool:
    """Return whether the surface is searched for a frame with too few recognised landmarks."""
    assert localizer.matcher is not None
    few = len(localizer.matcher.landmarks) < MANY_LANDMARKS  # else such an answer is not accepted
    return (lost == 0 or _due(lost, FIRST_FULL_SEARCH)) and (
        localizer.scene.surface is not None and (has_points(frame) or few)
    )


def _due(lost: int, first: int) -> bool:
    """Return whether ``lost`` is ``first`` times a power of two."""
    times, rest = divmod(lost, first)
    return rest == 0 and times > 0 and times & (times - 1) == 0
