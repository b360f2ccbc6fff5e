"""Acceptance: decide whether to trust a pose, without ground truth.

The poses of all methods are checked here. The code that finds a pose computes its diagnostics, from which thresholds give an
``Outcome`` and a sentence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.beyond_chance import Support
from bidnerf_core.localization.costs.surface import SurfaceCost
from bidnerf_core.localization.covariance import position_deviation
from bidnerf_core.localization.landmarks.map_camera import OTHER_CAMERA, MapCamera, map_cameras
from bidnerf_core.localization.landmarks.pose import LandmarkPose, MatchEvidence
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.refinement import RefinementResult
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import RenderedThresholds
from bidnerf_core.mapping import trace

WELL_BEFORE = 0.04
"""Fraction of the extent by which a line of sight must hit the surface too early to count as a violation."""
SIGHT_LINES = 300
"""Maximum number of lines of sight that are traced."""
FLAT = 0.02
"""Standard deviation of an image's colours, in [0, 1], below which a gain and a bias can fit any view to it."""


@dataclass(frozen=True)
class SurfaceThresholds:
    """Thresholds for accepting a pose on the baked surface."""

    on_surface: float = 0.85  # minimum fraction of the measured points on the surface
    colour_inliers: float = 0.42  # minimum fraction of the measured points on the surface and with its colour
    free_space_violations: float = 0.15  # maximum fraction of lines of sight that pass through the surface
    runner_up_margin: float = 0.15  # margin by which the second-best pose must be worse
    # minimum inlier fraction of the rendered rays, of those with depth if at least 5 % have it
    rendered_inliers: float = 0.8


@dataclass(frozen=True)
class SurfaceDiagnostics:
    """Measures of how well a pose explains the measured points; all but the margin are fractions between 0 and 1."""

    on_surface: float
    colour_inliers: float
    free_space_violations: float
    runner_up_margin: float
    rendered_inliers: float = 1.0  # 1 if nothing was rendered
    support: Support | None = None  # None: not compared with other poses

    def rejection(self, thresholds: SurfaceThresholds = SurfaceThresholds()) -> Verdict | None:
        """Return the most serious reason to reject the pose, or None."""
        if self.on_surface < thresholds.on_surface:
            return Verdict(
                Outcome.OFF_SURFACE, f"only {self.on_surface:.0%} of the measured points lie on the surface"
            )
        if self.colour_inliers < thresholds.colour_inliers:
            share = f"{self.colour_inliers:.0%} of the measured points have the surface's colour"
            return Verdict(Outcome.COLOUR_MISMATCH, f"only {share}")
        if self.free_space_violations > thresholds.free_space_violations:
            share = f"{self.free_space_violations:.0%} of the lines of sight"
            return Verdict(Outcome.FREE_SPACE_VIOLATED, f"{share} pass through the surface")
        if self.runner_up_margin < thresholds.runner_up_margin:
            return Verdict(Outcome.AMBIGUOUS, "another pose fits about as well")
        if not self.rendered_inliers >= thresholds.rendered_inliers:
            share = f"{self.rendered_inliers:.0%} of the rendered rays agree with the measurements"
            return Verdict(Outcome.RENDERING_MISMATCH, f"only {share}")
        return None if self.support is None else self.support.rejection()

    def verdict(self, thresholds: SurfaceThresholds = SurfaceThresholds()) -> Verdict:
        share = f"{self.colour_inliers:.0%} of the measured points match the surface in position and colour"
        confidence = None if self.support is None else self.support.confidence
        return self.rejection(thresholds) or Verdict(Outcome.CONVERGED, share, confidence)


def surface_diagnostics(judge: SurfaceCost, T: SE3, margin: float) -> SurfaceDiagnostics:
    """Measure how well the points of ``judge``, transformed by one pose, fit the surface.

    Each point counts by its inlier weight, so there is no hard threshold on single points. Points without a colour do not count
    for the colour inliers, unless no point has a colour.
    """
    near, alike = judge.inliers(judge.correspondences(T[None]))
    coloured = judge.cloud.coloured
    both = (near * alike)[:, coloured] if bool(coloured.any()) else near
    violations = free_space_violations(judge, T)
    return SurfaceDiagnostics(float(near.mean()), float(both.mean()), violations, margin)


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


def is_blank(frame: Frame) -> bool:
    """Return whether the image has a single colour, as if the lens were covered, or the frame has no colours at all."""
    shown = frame.rgb.flatten(0, 1) if frame.hidden is None else frame.rgb[~frame.hidden]
    return not frame.has_colour or float(shown.std(0, correction=0).max()) < FLAT


def free_space_violations(cost: SurfaceCost, T: SE3) -> float:
    """Return the fraction of lines of sight that hit the surface well before the measured point."""
    some, surface = cost.cloud.first(SIGHT_LINES), cost.surface
    T = T.to(surface.device)
    origins, ends = (T.apply(x.double()).to(some.points) for x in (some.origins, some.points))
    length = torch.linalg.vector_norm(ends - origins, dim=-1)
    met = trace(surface, origins, (ends - origins) / length.clamp(min=1e-9)[:, None])
    # Grazing rays hit coarse cells early.
    slack = max(WELL_BEFORE * surface.extent, 4 * surface.cell)
    return float((met < length - slack).float().mean())


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


@dataclass(frozen=True)
class DescentDiagnostics:
    """The measures by which the answer of a first-order descent is judged."""

    mean_loss: float  # of its last steps
    converged_loss: float  # below which it is accepted
    support: Support


def descent_verdict(
    mean_loss: float, threshold: float, finite: bool, reason: str, found: Support, least_explained: float
) -> Verdict:
    """Accept or reject the result of a first-order descent by the mean loss of its last steps and its support by other rays.

    ``reason`` explains why it ended. Low-contrast images have a small loss even at a wrong pose.
    """
    if not finite or not math.isfinite(mean_loss):
        return Verdict(Outcome.DIVERGED, reason)
    reason = f"{reason}; mean loss {mean_loss:.3g}, must be below {threshold:.3g}"
    if mean_loss >= threshold:
        return Verdict(Outcome.HIGH_LOSS, reason)
    rejection = found.rejection(least_explained)
    return (
        Verdict(Outcome.CONVERGED, reason, found.confidence)
        if rejection is None
        else replace(rejection, reason=f"{reason}, but {rejection.reason}")
    )


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
