"""Measuring a pose in one frame from a prediction: by tracked and recognised landmarks, by depth, or by colour."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.depth import UNKNOWN, DepthSensorModel
from bidnerf_core.frames import Frame, View, visible_at
from bidnerf_core.geometry import SE3, USUAL
from bidnerf_core.localization.acceptance import LandmarkThresholds, landmark_verdict
from bidnerf_core.localization.by_colour import TYPICAL_ERRORS, SearchResult, refine_by_colour
from bidnerf_core.localization.covariance import position_deviation
from bidnerf_core.localization.depth_scale import DepthScale
from bidnerf_core.localization.landmarks.pose import CameraDoubt, LandmarkPose, MatchEvidence
from bidnerf_core.localization.landmarks.query import pixel_threshold
from bidnerf_core.localization.problem import SceneMap, rig
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.settings import ByColourConfig, TrackerConfig
from bidnerf_core.localization.tracking.flow import Grey, alike, flow
from bidnerf_core.localization.tracking.motion import Motion, PoseEstimate, pixel_radius
from bidnerf_core.localization.tracking.points import (
    FRESH,
    INLIER,
    FollowedPoints,
    PointFit,
    fit_pose,
    with_motion,
)
from bidnerf_core.localization.tracking.recognition import (
    LandmarkDetector,
    flow_evidence,
    tracked_pose,
    well_spread,
)
from bidnerf_core.localization.tracking.state import TrackerState
from bidnerf_core.localization.tracking.surface import (
    SURFACE_BIAS,
    aligned,
    fit_shape,
    fused_with_surface,
    measured_cloud,
)
from bidnerf_core.mapping import SurfaceMap

WIDEST = 0.4
"""Maximum search radius around the predicted landmarks, as a fraction of the image's diagonal."""
ENOUGH_LANDMARKS = 40
"""Minimum number of tracked inliers at which no new landmarks are needed, and the pose needs no confirmation."""
VAGUE = 0.35
"""Maximum uncertainty of a prediction that shape alone may correct, as a fraction of the distance to the scene."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """A pose measured in a frame, the verdict on it, and the state for the next frame."""

    pose: PoseEstimate
    verdict: Verdict
    loss: float
    state: TrackerState  # with the points of this frame
    motion: Motion | None = None  # fused with the prediction, if the verdict already required it


def followed(state: TrackerState, image: Grey | None, frame: Frame, predicted: SE3) -> FollowedPoints:
    """Track the points of the last image to this one, and return those that were found."""
    if image is None or state.image is None or image.shape != state.image.shape or not len(state.points):
        return FollowedPoints.none()
    guess = state.points.projected(frame.intrinsics, predicted)
    pixels, found = flow(state.image, image, state.points.pixels, guess)
    if float(found.float().mean()) < 0.5:  # the prediction may be wrong
        again, found_again = flow(state.image, image, state.points.pixels, state.points.pixels)
        if int(found_again.sum()) > int(found.sum()):
            pixels, found = again, found_again
    fresh = (state.points.landmark == FRESH) & found
    if bool(fresh.any()):  # unlike corners, landmarks are known to be distinctive
        found[fresh.clone()] = alike(state.image, image, state.points.pixels[fresh], pixels[fresh])
    found &= visible_at(frame, pixels)
    return replace(state.points, pixels=pixels)[found]


@dataclass(frozen=True, eq=False)
class ByLandmarks:
    """Measures poses by landmarks: those tracked by optical flow, and new ones when these become few."""

    map: SceneMap
    detector: LandmarkDetector
    config: TrackerConfig
    sensor: DepthSensorModel = UNKNOWN

    def __call__(
        self, frame: Frame, image: Grey, state: TrackerState, points: FollowedPoints, predicted: Motion
    ) -> Measurement | None:
        """Return the pose by landmarks, fused with measured depth; None if too few are visible."""
        threshold = pixel_threshold(frame.intrinsics)
        correlation = self.detector.landmarks.correlation_of(len(points))
        found = fit_pose(
            points.observed(frame), predicted.T_world_camera, state.noise, threshold, correlation, state.moves
        )
        if found is not None:
            found = with_motion(found, self.detector.landmarks, trusts_camera=True)
            state = replace(state, moves=found.moves)
        judged = measured = None
        state = replace(state, age=state.age + 1)
        if found is not None:
            evidence = flow_evidence(found, frame.intrinsics)
            pose, verdict = self._judged(frame, points, found, evidence, state.doubt)
            judged = pose, not_by_chance(verdict, found.fit.noise, threshold)
            measured = self._fused(frame, state, points[found.inliers], *judged, predicted)
        if judged is None or measured is None or self._wants_more(state, judged[0], measured):
            fresh = self._recognized(frame, state, predicted, judged)
            if fresh is not None and (judged is None or fresh[1].accepted or not judged[1].accepted):
                pose, verdict, points, found, state = fresh
                return self._fused(frame, state, points[found.inliers], pose, verdict, predicted)
        if judged is None or measured is None:
            return None
        enough = judged[0].inliers >= ENOUGH_LANDMARKS
        return measured if enough else replace(measured, verdict=unconfirmed(measured.verdict))

    def _judged(
        self,
        frame: Frame,
        points: FollowedPoints,
        found: PointFit,
        evidence: MatchEvidence,
        doubt: CameraDoubt,
    ) -> tuple[LandmarkPose, Verdict]:
        pose = tracked_pose(points, found, evidence, self.detector.landmarks, doubt, frame.intrinsics)
        # The precision is checked after fusion with depth and the prediction.
        return pose, landmark_verdict(pose, LandmarkThresholds(precision=math.inf))

    def _wants_more(self, state: TrackerState, found: LandmarkPose, measured: Measurement) -> bool:
        few = found.inliers < max(ENOUGH_LANDMARKS, self.config.refresh_share * state.sought)
        return few or state.age >= self.config.refresh_frames or not measured.verdict.accepted

    def _recognized(
        self,
        frame: Frame,
        state: TrackerState,
        predicted: Motion,
        judged: tuple[LandmarkPose, Verdict] | None,
    ) -> tuple[LandmarkPose, Verdict, FollowedPoints, PointFit, TrackerState] | None:
        """Search for landmarks around the pose of the tracked ones, or else around the prediction."""
        camera = frame.intrinsics
        least, most = 1.5 * pixel_threshold(camera), WIDEST * math.hypot(camera.width, camera.height)
        if judged is not None and judged[1].accepted:
            T, radius = judged[0].T_world_camera, least
        else:
            T = predicted.T_world_camera
            radius = max(least, search_radius(predicted, camera))
            if radius > most:
                return None
        seen = self.detector(frame, T, radius, state.noise, state.moves)
        if seen is None:
            return None
        pose, verdict = self._judged(frame, seen.points, seen.found, seen.evidence, seen.doubt)
        if not verdict.accepted:
            return pose, verdict, seen.points, seen.found, state
        some = well_spread(seen.points.pixels[seen.found.inliers], camera, self.config.points)
        kept = torch.zeros(len(seen.points), dtype=torch.bool)
        kept[seen.found.inliers.nonzero()[:, 0][some]] = True
        state = replace(
            state,
            sought=len(some),
            age=0,
            doubt=seen.doubt,
        )
        return pose, verdict, seen.points, replace(seen.found, inliers=kept), state

    def _fused(
        self,
        frame: Frame,
        state: TrackerState,
        kept: FollowedPoints,
        found: LandmarkPose,
        verdict: Verdict,
        predicted: Motion,
    ) -> Measurement:
        """Fuse a pose by landmarks with depth and the prediction, and check whether it is then precise enough."""
        measured = self._with_depth(frame, state, kept, found, verdict)
        motion = predicted.updated(measured.pose)
        verdict = precise_enough(measured.verdict, motion.covariance, found.distance)
        return replace(measured, verdict=verdict, motion=motion)

    def _with_depth(
        self, frame: Frame, state: TrackerState, kept: FollowedPoints, found: LandmarkPose, verdict: Verdict
    ) -> Measurement:
        state = replace(state, points=kept, noise=found.noise, moves=bool(found.motion.any()))
        pose, surface = self._estimate(found), self.map.surface
        if not verdict.accepted or surface is None or not frame.has_depth:
            return Measurement(pose, verdict, found.noise, state)
        scale = DepthScale.of(found, self.sensor)
        if scale.objection is not None:
            verdict = replace(verdict, reason=f"{verdict.reason}, without depth: {scale.objection}")
            return Measurement(pose, verdict, found.noise, state)
        drawn = Generator().manual_seed(state.frames)
        cloud = measured_cloud(frame, self.config.depth_points, scale.estimate, drawn, found.motion)
        pose = fused_with_surface(pose, surface, cloud, self.config.depth_steps)
        verdict = replace(verdict, reason=f"{verdict.reason}, fused with depth")
        return Measurement(pose, verdict, found.noise, state)

    def _estimate(self, found: LandmarkPose) -> PoseEstimate:
        """Split a pose's covariance into noise and bias, as errors shared by an image's landmarks recur in the next image."""
        landmarks = self.detector.landmarks
        correlation = landmarks.correlation_of(len(found.correspondences))
        noise = (found.covariance - found.map_covariance) / correlation
        return PoseEstimate(found.T_world_camera, noise, found.full_covariance - noise)


def search_radius(predicted: Motion, camera: Intrinsics) -> float:
    """Return the radius (pixels) around its prediction within which a landmark is very likely to appear."""
    return INLIER * pixel_radius(predicted.covariance, camera.fx, predicted.reach)


def is_vague(predicted: Motion, camera: Intrinsics) -> bool:
    """Return whether a prediction, such as one after a gap, is too uncertain for a search for landmarks around it."""
    return search_radius(predicted, camera) > WIDEST * math.hypot(camera.width, camera.height)


def by_surface(
    surface: SurfaceMap, frame: Frame, state: TrackerState, predicted: Motion, config: TrackerConfig
) -> Measurement:
    """Return the pose by measured depth on the surface alone."""
    cloud = measured_cloud(frame, config.depth_points, 1.0, Generator().manual_seed(state.frames))
    translation, rotation = predicted.noise[:6, :6].diagonal().split(3)
    off = math.sqrt(float(translation.mean() + rotation.mean() * predicted.reach**2))
    found = aligned(surface, cloud, predicted.T_world_camera, predicted.covariance, 2 * off)
    covariance = found.covariance
    pose = PoseEstimate(found.T_world_camera, (1 - SURFACE_BIAS) * covariance, SURFACE_BIAS * covariance)
    loss = 1 - found.diagnostics.colour_inliers
    return Measurement(pose, found.diagnostics.verdict(), loss, state)


def by_shape(
    surface: SurfaceMap, frame: Frame, state: TrackerState, predicted: Motion, config: TrackerConfig
) -> Measurement:
    """Return the pose by measured depth without colours, already fused with the prediction."""
    cloud = measured_cloud(frame, config.depth_points, 1.0, Generator().manual_seed(state.frames))
    prediction = PoseEstimate(predicted.T_world_camera, predicted.noise[:6, :6], predicted.bias)
    translation, rotation = prediction.covariance.diagonal().split(3)
    off = math.sqrt(float(translation.mean() + rotation.mean() * predicted.reach**2))
    if off > VAGUE * predicted.reach:
        why = "no colours were recorded, and the prediction is too uncertain for the shape"
        return Measurement(prediction, Verdict(Outcome.UNDETERMINED, why), 1.0, state)
    found = fit_shape(surface, cloud, prediction, off)
    return Measurement(found.pose, found.verdict(), 1 - found.diagnostics.on_surface, state)


def by_colour(
    scene: SceneMap, frame: Frame, state: TrackerState, predicted: Motion, config: ByColourConfig
) -> Measurement:
    """Return the pose by the colours of rendered rays alone, which is far slower than the other measurements."""
    problem = rig(scene, [View(frame.replace(depth=None), SE3.identity())], predicted.T_world_camera)
    T, none = predicted.T_world_camera, torch.zeros(0, dtype=torch.float64)
    start = SearchResult(T[None], torch.zeros(1, dtype=torch.float64), math.inf, T[None], none)
    answer = refine_by_colour(problem, start, config, Generator().manual_seed(state.frames))
    covariance = answer.refined.covariance * max(1.0, config.steps.fine_rays / USUAL.rays_alone)
    if not bool(covariance.isfinite().all()):
        covariance = predicted.covariance
    pose = PoseEstimate(
        answer.refined.T.normalized(), (1 - SURFACE_BIAS) * covariance, SURFACE_BIAS * covariance
    )
    return Measurement(pose, answer.verdict, answer.refined.loss, state)


DETERMINED = 0.02, math.radians(3)
"""Maximum standard deviations of an accepted pose by depth or colour: fraction of the scene's extent, and radians."""


def not_by_chance(verdict: Verdict, noise: float, threshold: float) -> Verdict:
    """Return the verdict on tracked landmarks, or a rejection if their ``noise`` (pixels) is what chance would give.

    Points spread evenly over a disc of radius ``threshold`` (pixels) have a standard deviation of half that radius along each
    axis. If the flow has failed over a long interval, the landmarks fit no better than that.
    """
    if not verdict.accepted or noise <= threshold / 2:
        return verdict
    return Verdict(Outcome.AMBIGUOUS, f"{verdict.reason}, hardly better than by chance")


def unconfirmed(verdict: Verdict) -> Verdict:
    """Reject a pose by few tracked landmarks if none are recognised around it, since it may have drifted."""
    if not verdict.accepted:
        return verdict
    return Verdict(
        Outcome.TOO_FEW_MATCHES,
        f"{verdict.reason}, but the image does not confirm these few tracked ones",
    )


def precise_enough(verdict: Verdict, covariance: Float[Tensor, "6 6"], distance: float) -> Verdict:
    """Return the verdict, or a rejection if the position's uncertainty is too large for the scene's ``distance`` (metres)."""
    deviation = position_deviation(covariance)
    if not verdict.accepted or deviation <= LandmarkThresholds().precision * distance:
        return verdict
    why = f"but the position is uncertain by {deviation / distance:.1%} of the distance"
    return Verdict(Outcome.IMPRECISE, f"{verdict.reason}, {why}")


def determined(verdict: Verdict, covariance: Float[Tensor, "6 6"], extent: float) -> Verdict:
    """Return the verdict, or a rejection if the pose's covariance is large for a scene of this ``extent`` (metres)."""
    translation, rotation = (float(part.max().sqrt()) for part in covariance.diagonal().split(3))
    if not verdict.accepted or (translation <= DETERMINED[0] * extent and rotation <= DETERMINED[1]):
        return verdict
    why = f"one standard deviation is {translation:.3g} m and {math.degrees(rotation):.2g} deg"
    return Verdict(Outcome.UNDETERMINED, why)


def as_certain_as_usual(verdict: Verdict, covariance: Float[Tensor, "6 6"], typical: float) -> Verdict:
    """Return the verdict, or a rejection if the position is far less certain than those of the map's own images.

    ``typical`` is their median error (metres); 0 if unknown. It applies to frames without colours: along a corridor, the
    position is not observable, and is then predicted instead of measured.
    """
    deviation = position_deviation(covariance)
    if not verdict.accepted or typical <= 0 or deviation <= TYPICAL_ERRORS * typical:
        return verdict
    why = f"but the position is uncertain by {deviation:.3g} m, against {typical:.3g} m for images"
    return Verdict(Outcome.IMPRECISE, f"{verdict.reason}, {why}")


def shape_verdict(
    verdict: Verdict, covariance: Float[Tensor, "6 6"], distance: float, typical: float, stamped: bool
) -> Verdict:
    """Return the verdict on a pose by depth without colours, which also relies on the motion before it.

    Without a time stamp, the motion along directions that the shape does not determine is unknown.
    """
    if verdict.accepted and not stamped:
        return Verdict(Outcome.IMPRECISE, f"{verdict.reason}, but without a time stamp the motion is unknown")
    return as_certain_as_usual(precise_enough(verdict, covariance, distance), covariance, typical)
