"""``Tracker``: estimates the poses of a sequence's frames one by one, and reports immediately when it is lost."""

from __future__ import annotations

import math
import time as clocks
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch

from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame, is_blank
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import (
    POINTS,
    Clock,
    Grey,
    Localization,
    Measurement,
    Measurer,
    Motion,
    Outcome,
    Points,
    PoseEstimate,
    SceneMap,
    TrackerState,
    Verdict,
    extent_of,
    invert_correction,
    localize_by_landmarks,
    search_radius,
    shows_shape,
    start_covariance,
    within_limits,
)
from bidnerf_core.mapping import grey_image, limit_features
from bidnerf_core.maps.localizer import NO_DISTANCES, Localizer, Start, start_pose
from bidnerf_core.maps.scene import origin_of, unit_of
from bidnerf_core.maps.tracker_files import load_tracker_state, save_state
from bidnerf_core.settings import Above, Settings


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """Settings of a tracker."""

    # interval between frames without time stamps
    frame_seconds: Annotated[float, Above(0.0, 1e4), "SECONDS"] = 1 / 30


class Tracker:
    """Estimates the pose of each frame of a sequence from the frames before it.

    The tracker predicts each pose with a constant-velocity model and corrects the prediction by landmarks tracked with optical flow, by
    measured depth, or by colour. Each pose passes through the localizer's acceptance. After a rejected pose, which is marked as such, the
    tracker relocalizes in the following frames, and meanwhile continues by odometry. Its memory use does not grow. Trackers may share a
    localizer, even across threads, but a tracker itself belongs to one thread.
    """

    def __init__(self, localizer: Localizer, config: TrackerConfig | None = None, start: Start | None = None) -> None:
        """Track in the map of ``localizer``; ``start`` is a guess at the first T_world_camera.

        Raises ``InputError`` if ``localizer`` is not a ``Localizer``, or if its map has no distances.
        """
        if not isinstance(localizer, Localizer):
            raise InputError(
                f"got a {type(localizer).__name__}",
                where="Tracker",
                expected="a Localizer; Localizer(map) makes one" if isinstance(localizer, SceneMap) else "a Localizer",
            )
        self.localizer, config = localizer, TrackerConfig() if config is None else config
        self._scene = localizer.scene
        if not self._scene.has_distances:
            raise InputError(
                f"tracking needs positions, but {NO_DISTANCES};", expected="a map of photos from several places"
            )
        self._state = TrackerState(Clock(None, config.frame_seconds))
        self._origin = origin_of(self._scene)
        self._start = None if start is None else start_pose(start).translated(-self._origin)
        matcher = localizer.matcher if localizer.matches_landmarks else None
        self._landmarks = None if matcher is None else matcher.landmarks
        # The 600 strongest keypoints of an image are matched with landmarks.
        features = None if matcher is None else limit_features(matcher.features, 600)
        self._measure = Measurer(self._scene, self._landmarks, features, localizer.depth_sensor, localizer.config)
        self._extent = extent_of(self._scene)
        self._key = str(getattr(getattr(self._scene, "info", None), "weights", ""))

    @property
    def tracking(self) -> bool:
        """Whether the pose of the last frame was accepted."""
        return self._state.motion is not None and not self._state.lost

    @property
    def lost_frames(self) -> int:
        """The number of frames since the last accepted pose."""
        return self._state.lost

    def __call__(self, frame: Frame, time: float | None = None) -> Localization:
        """Estimate T_world_camera of the next frame.

        ``time`` (seconds, from any origin) is its time stamp; without one, the last interval is assumed. If the pose is
        rejected, the answer has an ``outcome`` other than ``CONVERGED``, and its pose is the best estimate with a corresponding
        covariance, or NaN before the sequence has been recognised. Raises ``InputError`` for a non-finite time, for anything but a frame, and if
        the map does not allow the first frame to be found without a start.
        """
        if not isinstance(frame, Frame):
            raise InputError(
                f"frame is a {type(frame).__name__}",
                expected="a Frame; Frame.open reads a photo, Frame.from_numpy an array",
            )
        began = clocks.perf_counter()
        clock, seconds = self._state.clock.step(time)
        frame = frame.over(self.localizer.scene.bounds.background)
        image = grey_image(frame.rgb) if frame.has_colour else None
        state = replace(self._state, clock=clock, frames=self._state.frames + 1)
        answer, state = self._step(frame, image, state, seconds)
        # Points are tracked from the last image, even across frames without one.
        state = state if image is None else replace(state, image=torch.from_numpy(image))
        self._state = state
        stated, taken = frame.intrinsics, state.correct(frame).intrinsics
        return replace(
            answer,
            method="track",
            seconds=clocks.perf_counter() - began,
            unit=unit_of(self._scene),
            focal_factor=math.sqrt(taken.fx * taken.fy / (stated.fx * stated.fy)),
            intrinsics=None if taken == stated else taken,
        ).translated(self._origin)

    def save(self, path: str | Path) -> None:
        """Write the tracker's state to a file, from which ``restore`` resumes tracking exactly."""
        save_state(Path(path), self._state, self._key)

    def restore(self, path: str | Path) -> None:
        """Continue from a saved state. Raises ``InputError`` for a damaged file, or for the state of a tracker in another map."""
        self._state = load_tracker_state(Path(path), self._key)

    def _step(
        self, stated: Frame, image: Grey | None, state: TrackerState, seconds: float
    ) -> tuple[Localization, TrackerState]:
        """Predict the pose and correct it by what the frame shows; if the result is rejected, search the map for the pose."""
        frame, motion, measured = state.correct(stated), state.motion, None
        if motion is None and self._start is not None:
            motion = self._at(frame, self._start, None)
            seconds = 0.0 if state.frames == 1 else seconds
        predicted = None if motion is None else motion.predict(seconds, state.clock.stamped)
        how = "constant velocity"
        if motion is not None and predicted is not None:
            if image is not None:
                before, points = state.image, Points.none()
                if before is not None and tuple(before.shape) == image.shape:
                    points = state.points.follow(before.numpy(), image, frame, predicted.T_world_camera)
                moved = self._measure.odometry(frame, points.fresh, motion, predicted, seconds)
                if moved is not None:
                    predicted, points, how = *moved, "odometry"
                state = replace(state, points=points)
            measured = self._measure(frame, image, state, predicted)
            if measured is not None and measured.answer.converged:
                return measured.answer, self._advance(frame, image, measured.motion, measured.state)
            if image is None and measured is not None:  # the shape still corrects some directions
                return measured.answer, replace(state, motion=measured.motion, lost=state.lost + 1)
        found = None
        is_vague = predicted is None or search_radius(frame.intrinsics, predicted.covariance, predicted.reach) is None
        if state.motion is None or is_vague or state.lost:
            found = self._relocalize(frame, image, state, predicted)
        if image is not None and found is not None and found.converged:
            return self._begin_at(stated, image, state, found)
        searchable = image is not None and (shows_shape(frame) or not is_blank(frame))
        state = replace(state, lost=state.lost + 1, searchable=state.searchable + searchable)
        if state.motion is None or predicted is None:
            if found is None:
                why = Verdict(Outcome.TOO_FEW_MATCHES, "the beginning of the sequence has not been recognised yet")
                path, losses = (self._start or SE3.unknown())[None], torch.zeros(0, dtype=torch.float64)
                found = Localization.of(why, path, losses, "track", clocks.perf_counter(), math.nan)
            return found, state
        # With each lost frame, 0.6 of the velocity is kept.
        state = replace(
            state,
            motion=replace(predicted, velocity=0.6 * predicted.velocity),
            points=self._corners(frame, image, state.points, predicted.T_world_camera),
        )
        why = Verdict(Outcome.TOO_FEW_MATCHES, "no landmarks were recognised around the prediction")
        if measured is not None:
            why = Verdict(measured.answer.outcome, measured.answer.reason, measured.answer.confidence)
        why = replace(why, reason=f"lost for {amount(state.lost, 'frame')}, bridged by {how}: {why.reason}")
        return Measurement.of(predicted, predicted, why, 1.0, state).answer, state

    def _at(self, frame: Frame, T: SE3, covariance: torch.Tensor | None) -> Motion:
        """Return the motion of a camera at a pose with unknown velocity; without a ``covariance``, the pose is as uncertain as a start."""
        usual = start_covariance(self._extent)
        noise, bias = (usual, 0 * usual) if covariance is None else (covariance / 2, covariance / 2)
        return Motion.at(PoseEstimate(T, noise, bias), self._reach(frame))

    def _advance(self, frame: Frame, image: Grey | None, motion: Motion, state: TrackerState) -> TrackerState:
        """Return the state after a frame whose pose was accepted."""
        away = (state.points.landmarks.positions - motion.T_world_camera.translation).norm(dim=-1)
        reach = float(away.median()) if len(away) else self._reach(frame)
        if self._landmarks is None:
            state = replace(state, points=self._corners(frame, image, state.points, motion.T_world_camera))
        return replace(state, motion=replace(motion, reach=reach), lost=0, searchable=0)

    def _begin_at(
        self, stated: Frame, image: Grey, state: TrackerState, found: Localization
    ) -> tuple[Localization, TrackerState]:
        """Start tracking at a pose found by a search."""
        reason = f"relocalized after {state.lost} frames: {found.reason}" if state.lost else found.reason
        if found.intrinsics is not None:
            state = replace(
                state,
                camera=invert_correction(stated.intrinsics, found.intrinsics),
                is_approximate=stated.focal_is_approximate,
            )
        frame, state = state.correct(stated), replace(state, points=Points.none(), searchable=0)
        motion = self._at(frame, found.T_world_camera, found.covariance)
        measured = self._measure(frame, image, state, motion)
        if measured is not None and measured.answer.converged:
            state = measured.state
        return replace(found, reason=reason, covariance=motion.covariance), self._advance(frame, image, motion, state)

    def _corners(self, frame: Frame, image: Grey | None, points: Points, T_world_camera: SE3) -> Points:
        """Return the corners among ``points``, or new corners at the pose of this frame if few are left."""
        points = points.fresh
        # New corners are detected once fewer than half of ``POINTS`` are left.
        if image is None or not frame.has_depth or len(points) >= 0.5 * POINTS:
            return points
        return Points.detect(frame, image, T_world_camera, POINTS, self.localizer.depth_sensor.noise)

    def _relocalize(
        self, frame: Frame, image: Grey | None, state: TrackerState, predicted: Motion | None
    ) -> Localization | None:
        """Search the map for the pose of a frame; None if no search is due or the frame is unsuitable.

        The search by landmarks runs for every image; the slower search of the whole surface runs at increasing intervals. Frames
        without an image are not searched for, since a shape alone fits many places.
        """
        lost = max(state.searchable, 0 if state.motion is None else min(state.lost, 1))
        if image is None or (not shows_shape(frame) and is_blank(frame)):
            return None
        # The whole surface is searched after this many lost frames, and again whenever their number has doubled.
        first = 4 if self._landmarks is not None else 1
        is_due = lost == 0 or (lost % first == 0 and (lost // first).bit_count() == 1)
        if self._landmarks is None and not is_due:
            return None
        problem = self.localizer.problem(frame, predicted.T_world_camera if predicted is not None and is_due else None)
        if self.localizer.matcher is not None and not is_due:
            problem = replace(problem, sensor=self.localizer.depth_sensor)
            return within_limits(localize_by_landmarks(problem, 0, state.frames), self.localizer.config)
        try:
            return self.localizer.solve(problem, state.frames)
        except InputError:
            if lost:  # the sequence has begun, so the frame is at fault, not the map or the settings
                return None
            raise

    def _reach(self, frame: Frame) -> float:
        """Return the typical distance (metres) of the visible scene."""
        depth = frame.depth
        if depth is None or not shows_shape(frame):
            return 0.3 * self._extent
        return float(depth[depth > 0].median())
