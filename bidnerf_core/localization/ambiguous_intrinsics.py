"""Rejects poses by colour alone whose focal length is approximate, or whose intrinsics differ slightly from those of the map's images.

Focal length and distance can hardly be separated without landmarks: a camera with a slightly longer focal length a little
further away takes nearly the same image. If the intrinsics are wrong, the pose is off by the difference.
"""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.localization.acceptance import LandmarkDiagnostics
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome
from bidnerf_core.localization.search.map_camera import OTHER_CAMERA, MapCamera, map_camera


def may_be_miscalibrated(problem: Problem) -> bool:
    """Whether the focal length is approximate, or the intrinsics are others than the map's but so near that they may be a mistake."""
    if _is_approximate(problem):
        return True
    cameras = () if problem.matcher is None else problem.matcher.landmarks.cameras
    known = [map_camera(view.frame.intrinsics, cameras) for view in problem.views]
    return any(_differs_a_little(camera) for camera in known if camera is not None)


def _is_approximate(problem: Problem) -> bool:
    return any(view.frame.focal_is_approximate for view in problem.views)


def _differs_a_little(camera: MapCamera) -> bool:
    return bool(camera.differs.any()) and camera.is_near(OTHER_CAMERA)


def without_ambiguous_intrinsics(found: Localization, problem: Problem) -> Localization:
    """Reject an accepted pose that neither landmarks nor depth determine where ``may_be_miscalibrated``."""
    by_colour = not problem.has_depth and not isinstance(found.diagnostics, LandmarkDiagnostics)
    if not (found.converged and by_colour and may_be_miscalibrated(problem)):
        return found
    if _is_approximate(problem):
        why = "the focal length is approximate, and colours alone hardly tell it from the distance"
        return replace(found, outcome=Outcome.IMPRECISE, reason=f"{why}; {found.reason}")
    why = "the intrinsics given are near those of the map's images, and without landmarks nothing tells which are right"
    return replace(found, outcome=Outcome.MISCALIBRATED, reason=f"{why}; {found.reason}")
