"""Acceptance: decide whether to trust an answer, without knowledge of the true pose.

The answers of all methods are judged here. The code that finds an answer measures its diagnostics; thresholds turn these
into an ``Outcome`` and a sentence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from bidnerf_core.frames.frame import Frame
from bidnerf_core.geometry.se3 import SE3
from bidnerf_core.localization.beyond_chance import Support
from bidnerf_core.localization.costs.surface import SurfaceCost
from bidnerf_core.localization.covariance import position_deviation
from bidnerf_core.localization.landmarks.pose import LandmarkPose
from bidnerf_core.localization.refinement import RefinementResult
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.settings import RenderedThresholds
from bidnerf_core.mapping.surface.casting import trace

WELL_BEFORE = 0.04
"""Share of the extent by which a line of sight must meet the surface too early to count as a violation."""
SIGHT_LINES = 300
"""Largest number of lines of sight that are traced."""
FLAT = 0.02
"""Standard deviation of an image's colours, in [0, 1], below which a gain and a bias make any view fit it."""
BLANK = Verdict(Outcome.UNDETERMINED, "the image is of a single colour, as if the lens were covered")
AMBIGUOUS = Verdict(Outcome.AMBIGUOUS, "another pose fits about as well")


@dataclass(frozen=True)
class SurfaceThresholds:
    """Thresholds for accepting an answer on the baked surface."""

    on_surface: float = 0.85  # share of the measured points that lie on the surface, at least
    colour_inliers: float = 0.42  # share that lies there and has its colour, at least
    free_space_violations: float = 0.15  # share of lines of sight that pass through the surface, at most
    runner_up_margin: float = 0.15  # by how much the next best answer must be worse
    # share of rendered rays, those with depth if 5 % of them have it, that agree with what was measured, at least
    rendered_inliers: float = 0.8


@dataclass(frozen=True)
class SurfaceDiagnostics:
    """Measures of how well a pose explains the measured points; all but the margin are shares between 0 and 1."""

    on_surface: float
    colour_inliers: float
    free_space_violations: float
    runner_up_margin: float
    rendered_inliers: float = 1.0  # where nothing was rendered
    support: Support | None = None  # None: not compared with other poses

    def rejection(self, thresholds: SurfaceThresholds = SurfaceThresholds()) -> Verdict | None:
        """Return the most serious reason to reject the pose, or None."""
        if self.on_surface < thresholds.on_surface:
            return Verdict(
                Outcome.OFF_SURFACE, f"only {self.on_surface:.0%} of the measured points lie on the surface"
            )
        if self.colour_inliers < thresholds.colour_inliers:
            share = f"{self.colour_inliers:.0%} of the measured points have the colour of the surface"
            return Verdict(Outcome.COLOUR_MISMATCH, f"only {share}")
        if self.free_space_violations > thresholds.free_space_violations:
            share = f"{self.free_space_violations:.0%} of the lines of sight"
            return Verdict(Outcome.FREE_SPACE_VIOLATED, f"{share} pass through the surface")
        if self.runner_up_margin < thresholds.runner_up_margin:
            return AMBIGUOUS
        if not self.rendered_inliers >= thresholds.rendered_inliers:
            share = f"{self.rendered_inliers:.0%} of the rendered rays agree with what was measured"
            return Verdict(Outcome.RENDERING_MISMATCH, f"only {share}")
        return None if self.support is None else self.support.rejection()

    def verdict(self, thresholds: SurfaceThresholds = SurfaceThresholds()) -> Verdict:
        share = f"{self.colour_inliers:.0%} of the measured points have the surface's place and colour"
        return self.rejection(thresholds) or Verdict(Outcome.CONVERGED, share)


def surface_diagnostics(judge: SurfaceCost, T: SE3, margin: float) -> SurfaceDiagnostics:
    """Measure how well the points of ``judge``, placed by one pose, lie on the surface.

    Each point counts by its inlier weight, so no hard threshold on single points is involved. Points without a colour are
    left out of the colour inliers, unless no point has a colour.
    """
    near, alike = judge.inliers(judge.correspondences(T[None]))
    coloured = judge.cloud.coloured
    both = (near * alike)[:, coloured] if bool(coloured.any()) else near
    violations = free_space_violations(judge, T)
    return SurfaceDiagnostics(float(near.mean()), float(both.mean()), violations, margin)


@dataclass(frozen=True)
class LandmarkDiagnostics:
    """Measures of how well a pose explains the features of an image. None of them has a unit of length."""

    inliers: int  # correspondences within three standard deviations
    matches: int  # by descriptors alone
    agreeing: int  # of these, those that agree with the pose
    log10_nfa: float  # logarithm of the number of such agreements expected by chance
    chance: float  # correspondences expected at a wrong pose
    visible: int  # landmarks that should be visible
    keypoints: int  # in the images
    spread: float  # share of the image's cells that hold a correspondence
    noise_ratio: float  # reprojection noise over that of the map's own images
    miscalibration: float  # probability that the given intrinsics are wrong
    precision: float  # standard deviation of the position by landmarks alone, over their distance
    estimated_calibration: bool  # whether the intrinsics were estimated along with the pose
    searched: bool  # whether landmarks found the pose, or only confirm one that was found on the surface
    on_surface: float | None = None  # share of the measured points that lie on the surface
    colour_inliers: float | None = None  # share that lies there and has its colour
    rolling_shutter: bool = (
        False  # whether the motion of the camera while its rows were exposed was estimated too
    )


def landmark_diagnostics(
    found: LandmarkPose, searched: bool = True, judge: SurfaceCost | None = None, T: SE3 | None = None
) -> LandmarkDiagnostics:
    """Return the diagnostics of a pose by landmarks; ``judge`` holds measured points, if any, which ``T`` places."""
    near = both = None
    if judge is not None and T is not None:
        near_points, alike = judge.inliers(judge.correspondences(T[None]))
        near, both = float(near_points.mean()), float((near_points * alike).mean())
    return LandmarkDiagnostics(
        found.inliers, found.matches, found.agreeing, found.log10_nfa, found.chance, found.visible,
        found.keypoints, found.spread, found.noise_ratio, found.doubt.wrong, found.position_deviation / found.distance,
        found.estimates_calibration, searched, near, both, found.has_motion,
    )  # fmt: skip


@dataclass(frozen=True)
class LandmarkThresholds:
    """Thresholds for accepting a pose by landmarks. They have no units, so they suit every scene and image."""

    log10_nfa: float = -12.0  # logarithm of the number of such agreements expected by chance, at most
    # correspondences within three standard deviations, at least; in proportion more if intrinsics are unknowns too
    inliers: int = 15
    above_chance: float = 3.0  # times as many as at a wrong pose, at least
    spread: float = 0.06  # share of the image's cells that hold one, at least
    # expected shift of the position by other intrinsics, probability times shift, as a share of the landmarks' distance, at most:
    # the farther off a pose may be, the less probable that must be
    expected_shift: float = 0.0025
    precision: float = 0.03  # standard deviation of the position, as a share of that distance, at most


def landmark_verdict(found: LandmarkPose, thresholds: LandmarkThresholds = LandmarkThresholds()) -> Verdict:
    """Judge a pose by how many landmarks agree with it, compared with chance, and how much of the image they cover."""
    share = f"{found.inliers} landmarks agree"
    unknowns = 10 if found.estimates_calibration else 6
    if found.log10_nfa > thresholds.log10_nfa or found.inliers < thresholds.inliers * unknowns / 6:
        return Verdict(Outcome.TOO_FEW_MATCHES, f"only {share} ({found.agreeing} of {found.matches} matches)")
    if found.inliers < thresholds.above_chance * found.chance:
        return Verdict(Outcome.AMBIGUOUS, f"{share}, about {found.chance:.0f} would by chance")
    if found.spread < thresholds.spread:
        return Verdict(Outcome.UNDETERMINED, f"{share}, all in {found.spread:.0%} of the image")
    if not bool(found.covariance.isfinite().all()):
        return Verdict(Outcome.UNDETERMINED, f"{share}, but do not determine the pose")
    if found.expected_shift > thresholds.expected_shift:
        return Verdict(Outcome.MISCALIBRATED, f"{share}{_doubted(found)}")
    if found.better_camera is not None:
        return Verdict(
            Outcome.MISCALIBRATED, f"{share}, but far more would with {found.better_camera.sentence}"
        )
    if found.calibration.is_stretched and not found.takes_map_camera:
        return Verdict(Outcome.MISCALIBRATED, f"{share}, but only with {found.calibration.sentence}")
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
            f": {found.calibration.sentence}" if found.changes_camera else ""
        )
    moving = ", with the motion of a rolling shutter" if found.has_motion else ""
    return Verdict(Outcome.CONVERGED, f"{share} within {found.noise:.1f} px{moving}{with_others}")


def _doubted(found: LandmarkPose) -> str:
    """Return what speaks for other intrinsics than those with which a pose was found."""
    taken = " with the map's intrinsics" if found.takes_map_camera else ""
    taken = " with estimated intrinsics" if found.estimates_calibration else taken
    with_taken = f"{taken} ({found.calibration.sentence})" if taken else ""
    if not found.doubt.other_is_known:
        return f"{with_taken}, but they suggest {found.doubt.other.sentence}"
    if found.estimates_calibration:
        return f"{with_taken}, but do not tell whether the given ones are right"
    other = found.calibration if found.takes_map_camera else found.doubt.other
    choice = "the given intrinsics or those of the map's images"
    return f", but do not tell whether {choice} are right: {other.sentence}"


def is_blank(frame: Frame) -> bool:
    """Return whether the image is of a single colour, as if the lens were covered, or the frame has no colours at all."""
    shown = frame.rgb.flatten(0, 1) if frame.hidden is None else frame.rgb[~frame.hidden]
    return not frame.has_colour or float(shown.std(0, correction=0).max()) < FLAT


def free_space_violations(cost: SurfaceCost, T: SE3) -> float:
    """Return the share of lines of sight that meet the surface well before the point that was measured."""
    some, surface = cost.cloud.first(SIGHT_LINES), cost.surface
    T = T.to(surface.device)
    origins, ends = (T.apply(x.double()).to(some.points) for x in (some.origins, some.points))
    length = torch.linalg.vector_norm(ends - origins, dim=-1)
    met = trace(surface, origins, (ends - origins) / length.clamp(min=1e-9)[:, None])
    # Grazing lines meet coarse cells early.
    slack = max(WELL_BEFORE * surface.extent, 4 * surface.cell)
    return float((met < length - slack).float().mean())


def rendered_verdict(found: RefinementResult, thresholds: RenderedThresholds) -> Verdict:
    """Judge a pose by fresh rendered rays: how many agree, and how much better than with other poses or a single colour."""
    if not bool(found.covariance.isfinite().all()):
        return Verdict(Outcome.UNDETERMINED, "what was measured does not determine the pose")
    share = f"{found.inliers:.0%} of fresh rays agree with what was measured"
    if not found.inliers >= thresholds.converged_inliers:
        return Verdict(Outcome.RENDERING_MISMATCH, f"{share}, expected {thresholds.converged_inliers:.0%}")
    if not found.step <= thresholds.converged_step:
        most = f"expected {thresholds.converged_step:g} at most"
        return Verdict(Outcome.NOT_SETTLED, f"fresh rays ask for a step of {found.step:.3g}, {most}")
    return found.support.rejection() or Verdict(Outcome.CONVERGED, share)


@dataclass(frozen=True)
class DescentDiagnostics:
    """The measures by which the answer of a first-order descent is judged."""

    mean_loss: float  # of its last steps
    converged_loss: float  # below which it is accepted
    support: Support


def descent_verdict(
    mean_loss: float, threshold: float, finite: bool, reason: str, found: Support, least_explained: float
) -> Verdict:
    """Judge a first-order descent by the mean loss of its last steps, and by how well other rays support its answer.

    ``reason`` explains why it ended. At a wrong pose, images of little contrast have a small loss too.
    """
    if not finite or not math.isfinite(mean_loss):
        return Verdict(Outcome.DIVERGED, reason)
    reason = f"{reason}; mean loss {mean_loss:.3g}, must be below {threshold:.3g}"
    if mean_loss >= threshold:
        return Verdict(Outcome.HIGH_LOSS, reason)
    rejection = found.rejection(least_explained)
    return (
        Verdict(Outcome.CONVERGED, reason)
        if rejection is None
        else replace(rejection, reason=f"{reason}, but {rejection.reason}")
    )
