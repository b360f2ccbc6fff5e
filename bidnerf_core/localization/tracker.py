"""``Tracker``: estimates the poses of a sequence's frames one by one, and reports immediately when it is lost."""

from __future__ import annotations

import time as clocks
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.localizer import Localizer, Start, map_with_distances, start_pose
from bidnerf_core.localization.problem import SceneMap, origin_of, unit_of
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import TrackerConfig
from bidnerf_core.localization.tracking.flow import Grey
from bidnerf_core.localization.tracking.measuring import (
    ByLandmarks,
    Measurement,
    by_colour,
    by_shape,
    by_surface,
    determined,
    followed,
    is_vague,
    shape_verdict,
)
from bidnerf_core.localization.tracking.motion import Clock, Motion, PoseEstimate
from bidnerf_core.localization.tracking.points import FRESH, FollowedPoints
from bidnerf_core.localization.tracking.recognition import LandmarkDetector, Odometry
from bidnerf_core.localization.tracking.relocalization import (
    has_points,
    is_searchable,
    relocalized,
    scene_extent,
    search_due,
    typical_error,
)
from bidnerf_core.localization.tracking.state import (
    METHOD,
    TrackerState,
    after_search,
    load_tracker_state,
    save_state,
    tracked_localization,
    unknown,
)
from bidnerf_core.mapping import SurfaceMap, grey_image, strongest

START = 0.03, 0.1
"""Standard deviations of a start of unknown uncertainty: fraction of the scene's extent, and radians."""
VELOCITY_KEPT = 0.6
"""Fraction of the velocity kept with each lost frame."""


class Tracker:
    """Estimates the pose of each frame of a sequence from the frames before it.

    It predicts the pose with a constant-velocity model and refines it locally by landmarks tracked with optical flow, by measured
    depth, or by colour. Each pose passes through the localizer's acceptance. After a rejected pose, which is marked as such, the
    tracker relocalizes in the following frames, and meanwhile continues by odometry. Its memory does not grow. Trackers may share
    a localizer, even across threads, but a tracker itself belongs to one thread.
    """

    def __init__(
        self, localizer: Localizer, config: TrackerConfig | None = None, start: Start | None = None
    ) -> None:
        """Track in the map of ``localizer``, which must have distances. ``start`` is a guess at the first T_world_camera."""
        config = TrackerConfig() if config is None else config
        self.localizer, self.config = _checked_localizer(localizer), config
        self._state = TrackerState(Clock(None, config.frame_seconds))
        self._origin = origin_of(localizer.scene)
        self._start = None if start is None else start_pose(start).translated(-self._origin)
        scene = map_with_distances(localizer)
        self._by_landmarks: ByLandmarks | None = None
        if localizer.matches_landmarks and localizer.matcher is not None:
            features = strongest(localizer.matcher.features, config.keypoints)
            detector = LandmarkDetector(localizer.matcher.landmarks, features)
            self._by_landmarks = ByLandmarks(scene, detector, config, localizer.depth_sensor)
        self._odometry = Odometry(config.points, config.refresh_share, localizer.depth_sensor.noise)

    @property
    def tracking(self) -> bool:
        """Whether the pose of the last frame was accepted."""
        return self._state.tracking

    @property
    def lost_frames(self) -> int:
        """The number of frames since the last accepted pose."""
        return self._state.lost

    def __call__(self, frame: Frame, time: float | None = None) -> Localization:
        """Estimate T_world_camera of the next frame.

        ``time`` (seconds, from any origin) is its time stamp; without one, the last interval is assumed. If the pose is
        rejected, the answer has an ``outcome`` other than ``CONVERGED``, and its pose is the best guess with a corresponding
        covariance. Raises ``InputError`` for a non-finite time, and if the map does not allow the first frame to be found
        without a start.
        """
        began = clocks.perf_counter()
        clock, seconds = self._state.clock.step(time)
        image = grey_image(frame.rgb) if frame.has_colour else None
        state = replace(self._state, clock=clock, frames=self._state.frames + 1)
        stated, frame = frame, frame if state.camera is None else state.camera.corrected(frame)
        if state.motion is None:
            answer, state = self._begun(frame, image, state)
        else:
            answer, state = self._continued(frame, image, state, state.motion, seconds)
        # Points are tracked from the last image, even across frames without one.
        self._state = state = state if image is None else replace(state, image=image)
        answer = replace(
            answer, seconds=clocks.perf_counter() - began, focal_factor=1.0, intrinsics=None,
            unit=unit_of(self.localizer.scene),
        )  # fmt: skip
        answer = answer.translated(self._origin)
        return answer if state.camera is None else state.camera.stated_in(answer, stated)

    def save(self, path: str | Path) -> None:
        """Write the tracker's state to a file, from which ``restore`` continues exactly."""
        save_state(Path(path), self._state, self._key)

    def restore(self, path: str | Path) -> None:
        """Continue from a saved state. Raises ``InputError`` for a damaged file or one for another map."""
        self._state = load_tracker_state(Path(path), self._key)

    def _begun(
        self, frame: Frame, image: Grey | None, state: TrackerState
    ) -> tuple[Localization, TrackerState]:
        """Find the first pose of the sequence: around the start, if there is one, or by a search."""
        if self._start is not None and state.frames == 1:
            motion = self._at_start(frame, self._start)
            answer, state = self._continued(frame, image, state, motion, 0.0)
            if answer.converged or image is None:
                return answer, state
        if image is None:  # a shape alone fits many places in a building
            return unknown(self._start, self._extent), replace(state, lost=state.lost + 1)
        found = None
        if search_due(self.localizer, frame, state.searchable, self.config.patience):
            found = relocalized(self.localizer, frame, self._start, state.searchable, state.frames)
        if found is None or not found.converged:
            answer = unknown(self._start, self._extent) if found is None else replace(found, method=METHOD)
            return answer, replace(state, lost=state.lost + 1, searchable=state.searchable + 1)
        return self._found(frame, image, state, found)

    def _at_start(self, frame: Frame, start: SE3) -> Motion:
        covariance = torch.diag(torch.tensor([START[0] * self._extent] * 3 + [START[1]] * 3).double() ** 2)
        return Motion.at(PoseEstimate(start, covariance, torch.zeros_like(covariance)), self._reach(frame))

    def _continued(
        self, frame: Frame, image: Grey | None, state: TrackerState, motion: Motion, seconds: float
    ) -> tuple[Localization, TrackerState]:
        """Estimate the pose from that of the last frame. If it is rejected, search again from the next frame on."""
        surface = self.localizer.scene.surface
        predicted = motion.predicted(seconds, state.clock.stamped)
        if image is None and surface is not None and has_points(frame):
            return self._by_shape(surface, frame, state, predicted)
        points = followed(state, image, frame, predicted.T_world_camera)
        predicted, points, how = self._by_odometry(frame, points, motion, predicted, seconds)
        measured = self._measured(frame, image, state, points, predicted)
        if measured is not None and measured.verdict.accepted:
            return self._accepted(frame, image, measured, predicted)
        if state.lost or is_vague(predicted, frame.intrinsics):
            T, waited = predicted.T_world_camera, state.waited + abs(seconds)
            lost = max(state.searchable, min(state.lost, 1))
            found = None
            if search_due(self.localizer, frame, lost, self.config.patience, waited):
                found = relocalized(self.localizer, frame, T, lost, state.frames)
                waited = waited if image is None else 0.0  # a frame with depth alone shows no landmarks
            state = replace(state, waited=waited)
            if found is not None and found.converged:
                return self._found(frame, image, state, found)
        state = self._adrift(frame, image, state, points, predicted)
        unseen = Verdict(Outcome.TOO_FEW_MATCHES, "no landmarks were recognised around the prediction")
        verdict = unseen if measured is None else measured.verdict
        reason = (
            f"lost for {state.lost} frame{'s' if state.lost > 1 else ''}, bridged by {how}: {verdict.reason}"
        )
        return tracked_localization(predicted, Verdict(verdict.outcome, reason), predicted, 1.0), state

    def _by_shape(
        self, surface: SurfaceMap, frame: Frame, state: TrackerState, predicted: Motion
    ) -> tuple[Localization, TrackerState]:
        """Correct the prediction by the depth of a frame without colours; there is no search.

        A fit that leaves the position uncertain is rejected, but still corrects the directions that the shape determines.
        """
        found = by_shape(surface, frame, state, predicted, self.config)
        if not found.verdict.accepted:
            verdict = replace(found.verdict, reason=f"not corrected by shape: {found.verdict.reason}")
            state = replace(state, motion=predicted, lost=state.lost + 1)
            return tracked_localization(predicted, verdict, predicted, found.loss), state
        motion = predicted.refined(found.pose)
        typical, stamped = typical_error(self.localizer), state.clock.stamped
        verdict = shape_verdict(found.verdict, motion.covariance, self._reach(frame), typical, stamped)
        state = replace(state, motion=motion, lost=0 if verdict.accepted else state.lost + 1)
        return tracked_localization(motion, verdict, predicted, found.loss), state

    def _by_odometry(
        self, frame: Frame, points: FollowedPoints, motion: Motion, predicted: Motion, seconds: float
    ) -> tuple[Motion, FollowedPoints, str]:
        """Return a prediction from the motion between the images, if corners of the last one were tracked."""
        corners = points[points.landmark == FRESH]
        if len(corners):
            moved = self._odometry.moved(frame, corners, motion, predicted.T_world_camera, seconds)
            if moved is not None:
                return *moved, "odometry"
        return predicted, points[points.landmark != FRESH], "constant velocity"

    def _measured(
        self, frame: Frame, image: Grey | None, state: TrackerState, points: FollowedPoints, predicted: Motion
    ) -> Measurement | None:
        """Measure the pose by the best method that map and frame allow."""
        if self._by_landmarks is not None and image is not None:
            known = points[points.landmark != FRESH]
            return self._by_landmarks(frame, image, state, known, predicted)
        surface = self.localizer.scene.surface
        if image is not None:
            state = replace(state, points=points)
        if surface is not None and has_points(frame):
            found = by_surface(surface, frame, state, predicted, self.config)
        elif image is None:
            return None
        else:
            found = by_colour(self.localizer.scene, frame, state, predicted, self.localizer.shared.by_colour)
        covariance = predicted.corrected(found.pose).covariance
        return replace(found, verdict=determined(found.verdict, covariance, self._extent))

    def _accepted(
        self, frame: Frame, image: Grey | None, measured: Measurement, predicted: Motion
    ) -> tuple[Localization, TrackerState]:
        """Fuse an accepted pose with the prediction, unless the measurement has already determined the motion."""
        motion = predicted.updated(measured.pose) if measured.motion is None else measured.motion
        reach = self._reach(frame, measured.state.points, measured.pose.T_world_camera)
        motion = replace(motion, reach=reach)
        state = replace(measured.state, motion=motion, lost=0, searchable=0, waited=0.0)
        if self._by_landmarks is None:
            corners = self._odometry.replenished(frame, image, state.points, motion.T_world_camera)
            state = replace(state, points=corners)
        return tracked_localization(motion, measured.verdict, predicted, measured.loss), state

    def _found(
        self, frame: Frame, image: Grey | None, state: TrackerState, found: Localization
    ) -> tuple[Localization, TrackerState]:
        """Start tracking at a pose found by a search."""
        covariance = found.covariance
        if covariance is None:
            covariance = self._at_start(frame, found.T_world_camera).covariance
        pose = PoseEstimate(found.T_world_camera, 0.5 * covariance, 0.5 * covariance)
        motion = Motion.at(pose, self._reach(frame))
        camera = state.camera
        if found.intrinsics is not None:
            frame, camera = after_search(frame, found.intrinsics, camera)
        state = replace(state, points=FollowedPoints.none(), motion=motion, camera=camera)
        measured = self._measured(frame, image, state, state.points, motion)
        if measured is not None and measured.verdict.accepted:
            state = measured.state
            motion = replace(motion, reach=self._reach(frame, state.points, pose.T_world_camera))
        if self._by_landmarks is None:
            corners = self._odometry.replenished(frame, image, state.points, pose.T_world_camera)
            state = replace(state, points=corners)
        reason = f"relocalized after {state.lost} frames: {found.reason}" if state.lost else found.reason
        answer = replace(found, method=METHOD, reason=reason, covariance=motion.covariance)
        return answer, replace(state, motion=motion, lost=0, searchable=0, waited=0.0)

    def _adrift(
        self, frame: Frame, image: Grey | None, state: TrackerState, points: FollowedPoints, predicted: Motion
    ) -> TrackerState:
        """Return the state of a lost tracker, with corners to track and a decayed velocity."""
        corners = self._odometry.replenished(frame, image, points, predicted.T_world_camera)
        motion = replace(predicted, velocity=VELOCITY_KEPT * predicted.velocity)
        return replace(
            state,
            motion=motion,
            points=corners,
            lost=state.lost + 1,
            searchable=state.searchable + (image is not None and is_searchable(frame)),
        )

    @property
    def _extent(self) -> float:
        """The size of the scene (metres)."""
        return scene_extent(self.localizer.scene)

    def _reach(
        self, frame: Frame, points: FollowedPoints | None = None, T_world_camera: SE3 | None = None
    ) -> float:
        """Return the distance (metres) to what the camera sees."""
        if points is not None and T_world_camera is not None and len(points):
            return float(
                torch.linalg.vector_norm(points.positions - T_world_camera.translation, dim=-1).median()
            )
        if has_points(frame):
            assert frame.depth is not None
            return float(frame.depth[frame.depth > 0].median())
        return 0.3 * self._extent

    @property
    def _key(self) -> str:
        info: Any = getattr(self.localizer.scene, "info", None)
        return "" if info is None else str(info.weights)


def _checked_localizer(given: object) -> Localizer:
    if isinstance(given, Localizer):
        return given
    hint = "; Localizer(map) makes one" if isinstance(given, SceneMap) else ""
    raise InputError(f"got a {type(given).__name__}", where="Tracker", expected=f"a Localizer{hint}")
