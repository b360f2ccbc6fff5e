"""Rejection of poses found without landmarks and with intrinsics that may be wrong.

Either the focal length is approximate or, if only colours were compared, the intrinsics differ slightly from those of the map's
images.

Without landmarks, focal length and distance can hardly be separated: a camera with a slightly longer focal length takes nearly
the same image from a little farther away. With a wrong focal length, measured points are scaled sideways, for which a shifted
pose partly compensates. Wrong intrinsics therefore make the pose wrong too.
"""

from __future__ import annotations

from dataclasses import replace

from bidnerf_core.localization.acceptance import LandmarkDiagnostics, SurfaceDiagnostics
from bidnerf_core.localization.landmarks.map_camera import OTHER_CAMERA, MapCamera, map_cameras
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.result import Localization, Outcome


def may_be_miscalibrated(problem: Problem) -> bool:
    """Return whether the focal length is approximate, or the intrinsics are suspiciously close to the map's but different."""
    if problem.focal_is_approximate:
        return True
    cameras = () if problem.matcher is None else problem.matcher.landmarks.cameras
    known = [camera for view in problem.views for camera in map_cameras(view.frame.intrinsics, cameras)]
    return any(_differs_a_little(camera) for camera in known)


def _differs_a_little(camera: MapCamera) -> bool:
    return bool(camera.differs.any()) and camera.is_near(OTHER_CAMERA)


def without_ambiguous_intrinsics(found: Localization, problem: Problem) -> Localization:
    """Reject an accepted pose if its intrinsics may be wrong (see ``may_be_miscalibrated``) and no landmarks confirm them.

    With measured depth, only an approximate focal length is a reason to reject, unless the pose is based on lidar rays alone,
    which do not depend on it.
    """
    if not found.converged or isinstance(found.diagnostics, LandmarkDiagnostics):
        return found
    if problem.focal_is_approximate and not _is_by_lidar(found, problem):
        why = "the focal length is approximate, and only landmarks can separate it from the distance"
        return replace(found, outcome=Outcome.IMPRECISE, reason=f"{why}; {found.reason}")
    if problem.has_depth or not may_be_miscalibrated(problem):
        return found
    why = "the given intrinsics are close to those of the map's images, and only landmarks can show which are right"
    return replace(found, outcome=Outcome.MISCALIBRATED, reason=f"{why}; {found.reason}")


def _is_by_lidar(found: Localization, problem: Problem) -> bool:
    """Return whether a pose is based on measured points, none of them from a depth image."""
    by_points = isinstance(found.diagnostics, SurfaceDiagnostics)
    return by_points and not any(view.frame.has_depth for view in problem.views)
