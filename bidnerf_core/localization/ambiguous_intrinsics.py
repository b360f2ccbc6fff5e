"""Rejects poses without landmarks whose focal length is approximate, or, by colour alone, slightly other than that of the map's images.

Focal length and distance can hardly be separated without landmarks: a camera with a slightly longer focal length a little
further away takes nearly the same image. Measured points are spread sideways by a wrong focal length, for which a shifted pose partly
makes up. If the intrinsics are wrong, the pose is off by the difference.
"""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.localization.acceptance import LandmarkDiagnostics, SurfaceDiagnostics
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome
from bidnerf_core.localization.search.map_camera import OTHER_CAMERA, MapCamera, map_camera


def may_be_miscalibrated(problem: Problem) -> bool:
    """Whether the focal length is approximate, or the intrinsics are others than the map's but so near that they may be a mistake."""
    if problem.focal_is_approximate:
        return True
    cameras = () if problem.matcher is None else problem.matcher.landmarks.cameras
    known = [map_camera(view.frame.intrinsics, cameras) for view in problem.views]
    return any(_differs_a_little(camera) for camera in known if camera is not None)


def _differs_a_little(camera: MapCamera) -> bool:
    return bool(camera.differs.any()) and camera.is_near(OTHER_CAMERA)


def without_ambiguous_intrinsics(found: Localization, problem: Problem) -> Localization:
    """Reject an accepted pose where ``may_be_miscalibrated`` and no landmarks tell the intrinsics.

    Where depth is measured, only an approximate focal length is a reason, and none where the pose is by the rays of a lidar alone, which
    do not depend on it.
    """
    if not found.converged or isinstance(found.diagnostics, LandmarkDiagnostics):
        return found
    if problem.focal_is_approximate and not _is_by_lidar(found, problem):
        why = "the focal length is approximate, and only landmarks would tell it from the distance"
        return replace(found, outcome=Outcome.IMPRECISE, reason=f"{why}; {found.reason}")
    if problem.has_depth or not may_be_miscalibrated(problem):
        return found
    why = "the intrinsics given are near those of the map's images, and without landmarks nothing tells which are right"
    return replace(found, outcome=Outcome.MISCALIBRATED, reason=f"{why}; {found.reason}")


def _is_by_lidar(found: Localization, problem: Problem) -> bool:
    """Whether a pose is by measured points of which none come from an image's depth."""
    by_points = isinstance(found.diagnostics, SurfaceDiagnostics)
    return by_points and not any(view.frame.has_depth for view in problem.views)
