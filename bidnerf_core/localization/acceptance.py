"""Acceptance: decide whether to trust a pose, without ground truth.

The poses of all methods are checked here. The code that finds a pose computes its diagnostics, from which thresholds give an
``Outcome`` and a sentence.
"""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.costs.surface import SurfaceCost
from bidnerf_core.localization.covariance import position_deviation
from bidnerf_core.localization.landmarks.map_camera import OTHER_CAMERA, MapCamera, map_cameras
from bidnerf_core.localization.landmarks.pose import LandmarkPose, MatchEvidence
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import RefinementResult
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import RenderedThresholds
from bidnerf_core.localization.support import SurfaceDiagnostics


@dataclass(frozen=True)
class LandmarkDiagnostics(MatchEvidence):
    """Measures of how well a pose explains the features of an image; none depends on the unit of length."""

    inliers: int  # correspondences within three standard deviations
    spread: float  # fraction of the image's cells that contain a correspondence
    noise_ratio: float  # ratio of the reprojection noise to that of the map's own images
    miscalibration: float  # probability that the given intrinsics are wrong
    precision: float  # standard deviation of the position from landmarks alone, relative to their distance
    estimated_calibration: bool  # whether the intrinsics were estimated along with the pose
    searched: bool  # whether landmarks found the pose, or only confirm one found on the surface
    on_surface: float | None = None  # fraction of the measured points on the surface
    colour_inliers: float | None = None  # fraction of the measured points on the surface and with its colour
    rolling_shutter: bool = False  # whether the camera's motion during the readout was estimated too


def landmark_diagnostics(
    found: LandmarkPose, searched: bool = True, judge: SurfaceCost | None = None, T: SE3 | None = None
) -> LandmarkDiagnostics:
    """Return the diagnostics of a pose by landmarks, and those of any measured points in ``judge`` at the pose ``T``."""
    near = both = None
    if judge is not None and T is not None:
        near_points, alike = judge.inliers(judge.correspondences(T[None]))
        near, both = float(near_points.mean()), float((near_points * alike).mean())
    return LandmarkDiagnostics(
        **vars(found.evidence), inliers=found.inliers, spread=found.spread, noise_ratio=found.noise_ratio,
        miscalibration=found.doubt.wrong, precision=found.position_deviation / found.distance,
        estimated_calibration=found.estimates_calibration, searched=searched, on_surface=near, colour_inliers=both,
        rolling_shutter=found.has_motion,
    )  # fmt: skip


@dataclass(frozen=True)
class LandmarkThresholds:
    """Thresholds for accepting a pose estimated from landmarks.

    All are dimensionless, so they apply to any scene and image size.
    """

    log10_nfa: float = -12.0  # maximum logarithm of the number of false alarms
    # minimum number of correspondences within three standard deviations; proportionally more if intrinsics are estimated
    inliers: int = 15
    above_chance: float = 3.0  # minimum ratio to the number expected at a wrong pose
    spread: float = 0.06  # minimum fraction of the image's cells that contain a correspondence
    # maximum expected shift of the position under other intrinsics (probability times shift), relative to the landmarks'
    # distance: the larger the possible error, the less probable it must be
    relative_shift: float = 0.0025
    precision: float = 0.03  # maximum standard deviation of the position, relative to that distance


def landmark_verdict(found: LandmarkPose, thresholds: LandmarkThresholds = LandmarkThresholds()) -> Verdict:
    """Accept or reject a pose by its number of landmark inliers, compared with chance, and their coverage of the image."""
    share = f"{found.inliers} landmark inliers"
    unknowns = 10 if found.estimates_calibration else 6
    if found.log10_nfa > thresholds.log10_nfa or found.inliers < thresholds.inliers * unknowns / 6:
        return Verdict(Outcome.TOO_FEW_MATCHES, f"only {share} ({found.agreeing} of {found.matches} matches)")
    if found.inliers < thresholds.above_chance * found.chance:
        return Verdict(Outcome.AMBIGUOUS, f"{share}, but about {found.chance:.0f} are expected by chance")
    if found.spread < thresholds.spread:
        return Verdict(Outcome.UNDETERMINED, f"{share}, all in {found.spread:.0%} of the image")
    if not bool(found.covariance.isfinite().all()):
        return Verdict(Outcome.UNDETERMINED, f"{share}, but they do not determine the pose")
    if found.relative_shift > thresholds.relative_shift:
        return Verdict(Outcome.MISCALIBRATED, f"{share}{_doubted(found)}")
    if found.better_camera is not None:
        return Verdict(
            Outcome.MISCALIBRATED,
            f"{share}, but far more with {found.better_camera.compared(found.given_or_assumed)}",
        )
    if found.calibration.is_stretched and not found.takes_map_camera:
        return Verdict(
            Outcome.MISCALIBRATED,
            f"{share}, but only with {found.calibration.compared(found.given_or_assumed)}",
        )
    deviation = position_deviation(found.stated_covariance + found.doubt.covariance)
    if not deviation <= thresholds.precision * found.distance:
        cause = ", as the intrinsics had to be estimated" if found.estimates_calibration else ""
        return Verdict(
            Outcome.IMPRECISE,
            f"{share}, but the position is uncertain by {deviation / found.distance:.1%} of the distance{cause}",
        )
    with_others = ""
    if found.takes_map_camera or found.estimates_calibration:
        whose = "the map's" if found.takes_map_camera else "estimated"
        with_others = f", with {whose} intrinsics" + (
            f": {found.calibration.compared(found.given_or_assumed)}" if found.changes_camera else ""
        )
    moving = ", with the motion of a rolling shutter" if found.has_motion else ""
    return Verdict(Outcome.CONVERGED, f"{share} within {found.noise:.1f} px{moving}{with_others}")


def _doubted(found: LandmarkPose) -> str:
    """Return the part of the reason that explains why other intrinsics may be right."""
    taken = " with the map's intrinsics" if found.takes_map_camera else ""
    taken = " with estimated intrinsics" if found.estimates_calibration else taken
    with_taken = f"{taken} ({found.calibration.compared(found.given_or_assumed)})" if taken else ""
    if not found.doubt.other_is_known:
        return f"{with_taken}, but they suggest {found.doubt.other.compared(found.given_or_assumed)}"
    if found.estimates_calibration:
        return f"{with_taken}, but they do not show whether the {found.given_or_assumed} ones are right"
    other = found.calibration if found.takes_map_camera else found.doubt.other
    choice = f"the {found.given_or_assumed} intrinsics or those of the map's images"
    return f", but they do not show whether {choice} are right: {other.compared(found.given_or_assumed)}"


def rendered_verdict(found: RefinementResult, thresholds: RenderedThresholds) -> Verdict:
    """Accept or reject a pose by newly drawn rays: their inliers, and their support against rival poses and a plain image."""
    if not bool(found.covariance.isfinite().all()):
        return Verdict(Outcome.UNDETERMINED, "the measurements do not determine the pose")
    share = f"{found.inliers:.0%} of newly drawn rays agree with the measurements"
    if not found.inliers >= thresholds.converged_inliers:
        return Verdict(Outcome.RENDERING_MISMATCH, f"{share}, expected {thresholds.converged_inliers:.0%}")
    if not found.step <= thresholds.converged_step:
        most = f"expected {thresholds.converged_step:g} at most"
        return Verdict(
            Outcome.NOT_SETTLED, f"newly drawn rays give a further step of {found.step:.3g}, {most}"
        )
    return found.support.rejection() or Verdict(Outcome.CONVERGED, share, found.support.confidence)


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

    Without landmarks, focal length and distance can hardly be separated: a camera with a slightly longer focal length takes nearly
    the same image from a little farther away. With a wrong focal length, measured points are scaled sideways, for which a shifted
    pose partly compensates. Wrong intrinsics therefore make the pose wrong too.

    With measured depth, only an approximate focal length is a reason to reject, unless the pose is based on lidar rays alone,
    which do not depend on it.
    """
    if not found.converged or isinstance(found.diagnostics, LandmarkDiagnostics):
        return found
    if problem.focal_is_approximate and not _is_by_lidar(found, problem):
        why = "the focal length is approximate, and only landmarks can separate it from the distance"
        return found.rejected(Verdict(Outcome.IMPRECISE, why))
    if problem.has_depth or not may_be_miscalibrated(problem):
        return found
    why = "the given intrinsics are close to those of the map's images, and only landmarks can show which are right"
    return found.rejected(Verdict(Outcome.MISCALIBRATED, why))


def _is_by_lidar(found: Localization, problem: Problem) -> bool:
    """Return whether a pose is based on measured points, none of them from a depth image."""
    by_points = isinstance(found.diagnostics, SurfaceDiagnostics)
    return by_points and not any(view.frame.has_depth for view in problem.views)
