"""``Tracker``: estimates the poses of a sequence's frames one by one, and reports immediately when it is lost."""

from __future__ import annotations

import math
import time as clocks
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.auto import localization_of, unrecognized, within_risk
from bidnerf_core.localization.by_surface import is_blank
from bidnerf_core.localization.localizer import Localizer, Start, map_with_distances, start_pose
from bidnerf_core.localization.loop import Loop
from bidnerf_core.localization.problem import SceneMap, origin_of, unit_of
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import TrackerConfig
from bidnerf_core.localization.tracking.flow import Grey
from bidnerf_core.localization.tracking.keyframes import FRESH, Points
from bidnerf_core.localization.tracking.measuring import Measurement, Measurer, search_radius, shows_shape
from bidnerf_core.localization.tracking.motion import Clock, Motion, PoseEstimate
from bidnerf_core.localization.tracking.state import (
    CorrectedCamera,
    TrackerState,
    load_tracker_state,
    save_state,
)
from bidnerf_core.mapping import grey_image, strongest

METHOD = "track"
"""Method name of a tracker's poses."""
START = 0.03, 0.1
"""Standard deviations of a start of unknown uncertainty: fraction of the scene's extent, and radians."""
VELOCITY_KEPT = 0.6
"""Fraction of the velocity kept with each lost frame."""
FIRST_FULL_SEARCH = 4
"""The number of lost frames after which the whole surface is searched, and again each time that number has doubled."""
LONG_WAIT = 0.25
"""Interval without a search, in seconds, after which every frame is searched, as such frames arrive slowly enough."""


class Tracker:
    """Estimates the pose of each frame of a sequence from the frames before it.

    It predicts the pose with a constant-velocity model and corrects it by landmarks tracked with optical flow, by measured
    depth, or by colour. Each pose passes through the localizer's acceptance. After a rejected pose, which is marked as such, the
    tracker relocalizes in the following frames, and meanwhile continues by odometry. Its memory does not grow. Trackers may share
    a localizer, even across threads, but a tracker itself belongs to one thread.
    """

    def __init__(
        self, localizer: Localizer, config: TrackerConfig | None = None, start: Start | None = None
    ) -> None:
        """Track in the map of ``localizer``, which must have distances. ``start`` is a guess at the first T_world_camera."""
        if not isinstance(localizer, Localizer):
            raise InputError(
                f"got a {type(localizer).__name__}", where="Tracker",
                expected="a Localizer; Localizer(map) makes one" if isinstance(localizer, SceneMap) else "a Localizer",
            )  # fmt: skip
        self.localizer, self.config = localizer, TrackerConfig() if config is None else config
        self._scene = map_with_distances(localizer)
        self._state = TrackerState(Clock(None, self.config.frame_seconds))
        self._origin = origin_of(self._scene)
        self._start = None if start is None else start_pose(start).translated(-self._origin)
        matcher = localizer.matcher if localizer.matches_landmarks else None
        self._landmarks = None if matcher is None else matcher.landmarks
        features = None if matcher is None else strongest(matcher.features, self.config.keypoints)
        self._measure = Measurer(self._scene, self._landmarks, features, localizer.depth_sensor, self.config)
        surface, bounds = self._scene.surface, self._scene.bounds
        corners = torch.tensor([bounds.lower, bounds.upper])
        self._extent = float((corners[1] - corners[0]).norm()) if surface is None else surface.extent

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
        frame = frame.over(self.localizer.scene.bounds.background)
        image = grey_image(frame.rgb) if frame.has_colour else None
        state = replace(self._state, clock=clock, frames=self._state.frames + 1)
        stated, frame = frame, frame if state.camera is None else state.camera.corrected(frame)
        if state.motion is None:
            answer, state = self._beginning(frame, image, state)
        else:
            answer, state = self._continued(frame, image, state, state.motion, seconds)
        # Points are tracked from the last image, even across frames without one.
        self._state = state = state if image is None else replace(state, image=torch.from_numpy(image))
        answer = replace(
            answer, method=METHOD, seconds=clocks.perf_counter() - began, focal_factor=1.0, intrinsics=None,
            unit=unit_of(self._scene),
        ).translated(self._origin)  # fmt: skip
        return answer if state.camera is None else state.camera.stated_in(answer, stated)

    def save(self, path: str | Path) -> None:
        """Write the tracker's state to a file, from which ``restore`` continues exactly."""
        save_state(Path(path), self._state, self._key)

    def restore(self, path: str | Path) -> None:
        """Continue from a saved state. Raises ``InputError`` for a damaged file or one for another map."""
        self._state = load_tracker_state(Path(path), self._key)

    def _beginning(
        self, frame: Frame, image: Grey | None, state: TrackerState
    ) -> tuple[Localization, TrackerState]:
        """Find the first pose of the sequence: around the start, if there is one, or by a search."""
        start = self._start
        if start is not None and state.frames == 1:
            answer, state = self._continued(frame, image, state, self._at_start(frame, start), 0.0)
            if answer.converged or image is None:
                return answer, state
        found = None
        if image is not None and self._is_search_due(
            frame, state.searchable
        ):  # a shape alone fits many places
            found = self._relocalized(frame, start, state.searchable, state.frames)
        if found is not None and image is not None and found.converged:
            return self._found(frame, image, state, found)
        if found is None:
            deviations = torch.tensor([self._extent] * 3 + [math.pi] * 3, dtype=torch.float64)
            T, none = SE3.identity() if start is None else start, torch.zeros(0, dtype=torch.float64)
            why = "the beginning of the sequence has not been recognised yet"
            found = Localization(
                T, Outcome.TOO_FEW_MATCHES, why, 0, 0.0, 1.0, METHOD, T[None], none, deviations.square().diag()
            )  # fmt: skip
        return found, replace(state, lost=state.lost + 1, searchable=state.searchable + (image is not None))

    def _at_start(self, frame: Frame, start: SE3) -> Motion:
        covariance = torch.diag(torch.tensor([START[0] * self._extent] * 3 + [START[1]] * 3).double() ** 2)
        return Motion.at(PoseEstimate(start, covariance, torch.zeros_like(covariance)), self._reach(frame))

    def _continued(
        self, frame: Frame, image: Grey | None, state: TrackerState, motion: Motion, seconds: float
    ) -> tuple[Localization, TrackerState]:
        """Estimate the pose from that of the last frame. If it is rejected, search again from the next frame on."""
        predicted = motion.predicted(seconds, state.clock.stamped)
        how = "constant velocity"
        if image is not None:
            before, points = state.image, Points.none()
            if before is not None and tuple(before.shape) == image.shape:
                points = state.points.followed(before.numpy(), image, frame, predicted.T_world_camera)
            moved = self._measure.odometry(
                frame, points[points.landmark == FRESH], motion, predicted, seconds
            )
            if moved is not None:
                predicted, points, how = *moved, "odometry"
            state = replace(state, points=points)
        measured = self._measure(frame, image, state, predicted)
        if measured is not None and measured.verdict.accepted:
            return self._answer(measured, predicted), self._after(frame, image, measured)
        if image is None and measured is not None:  # the shape still corrects some directions
            state = replace(state, motion=measured.motion, lost=state.lost + 1)
            return self._answer(measured, predicted), state
        if state.lost or search_radius(frame, predicted) is None:
            T, waited = predicted.T_world_camera, state.waited + abs(seconds)
            lost, found = max(state.searchable, min(state.lost, 1)), None
            if self._is_search_due(frame, lost, waited):
                found = self._relocalized(frame, T, lost, state.frames)
                waited = waited if image is None else 0.0  # a frame with depth alone shows no landmarks
            state = replace(state, waited=waited)
            if image is not None and found is not None and found.converged:
                return self._found(frame, image, state, found)
        searchable = image is not None and (shows_shape(frame) or not is_blank(frame))
        state = replace(
            state, lost=state.lost + 1, searchable=state.searchable + searchable,
            motion=replace(predicted, velocity=VELOCITY_KEPT * predicted.velocity),
            points=self._corners(frame, image, state.points, predicted.T_world_camera),
        )  # fmt: skip
        unseen = Verdict(Outcome.TOO_FEW_MATCHES, "no landmarks were recognised around the prediction")
        verdict = unseen if measured is None else measured.verdict
        reason = f"lost for {amount(state.lost, 'frame')}, bridged by {how}: {verdict.reason}"
        return self._answer(
            Measurement(predicted, replace(verdict, reason=reason), 1.0, state), predicted
        ), state

    def _answer(self, measured: Measurement, predicted: Motion) -> Localization:
        """Return the answer for a frame; its path leads from the prediction to the pose."""
        T, verdict = measured.motion.T_world_camera, measured.verdict
        return Localization(
            T, verdict.outcome, verdict.reason, 1, 0.0, measured.loss, METHOD, SE3.stack([predicted.T_world_camera, T]),
            torch.tensor([measured.loss], dtype=torch.float64), measured.motion.covariance, confidence=verdict.confidence,
        )  # fmt: skip

    def _after(self, frame: Frame, image: Grey | None, measured: Measurement) -> TrackerState:
        """Return the state after a frame whose pose was accepted."""
        motion, state = measured.motion, measured.state
        points, T = state.points[state.points.landmark != FRESH], motion.T_world_camera
        reach = (
            float((points.positions - T.translation).norm(dim=-1).median())
            if len(points)
            else self._reach(frame)
        )
        if self._landmarks is None:
            state = replace(state, points=self._corners(frame, image, state.points, T))
        return replace(state, motion=replace(motion, reach=reach), lost=0, searchable=0, waited=0.0)

    def _found(
        self, frame: Frame, image: Grey, state: TrackerState, found: Localization
    ) -> tuple[Localization, TrackerState]:
        """Start tracking at a pose found by a search."""
        reason = f"relocalized after {state.lost} frames: {found.reason}" if state.lost else found.reason
        motion, camera = self._at_start(frame, found.T_world_camera), state.camera
        if found.covariance is not None:
            half = 0.5 * found.covariance
            motion = Motion.at(PoseEstimate(found.T_world_camera, half, half), motion.reach)
        if found.intrinsics is not None:
            later = CorrectedCamera(frame.intrinsics, found.intrinsics, frame.focal_is_approximate)
            camera = camera.then(later) if camera is not None and camera.applies_to(frame) else later
            frame = later.corrected(frame)
        state = replace(state, points=Points.none(), camera=camera, searchable=0)
        measured = self._measure(frame, image, state, motion)
        if measured is not None and measured.verdict.accepted:
            reason = f"{reason}; {measured.verdict.reason}"
        else:
            measured = Measurement(motion, Verdict(found.outcome, found.reason), found.loss, state)
        state = self._after(frame, image, replace(measured, motion=motion))
        return replace(found, reason=reason, covariance=motion.covariance), state

    def _corners(self, frame: Frame, image: Grey | None, points: Points, T_world_camera: SE3) -> Points:
        """Return the corners among ``points``, or new ones at the pose of this frame if they have become few."""
        points, count = points[points.landmark == FRESH], self.config.points
        if image is None or not frame.has_depth or len(points) >= self.config.refresh_share * count:
            return points
        return Points.measured(frame, image, T_world_camera, count, self.localizer.depth_sensor.noise)

    # Searching.

    def _is_search_due(self, frame: Frame, lost: int, waited: float = 0.0) -> bool:
        """Return whether to search for the pose of a frame instead of skipping it to save time.

        In maps with landmarks, the first ``patience`` frames after a loss are searched, then every second one, or every one if
        ``waited``, the time (seconds) without a search, is long. ``lost`` is as for ``_relocalized``.
        """
        if not shows_shape(frame) and is_blank(frame):
            return False
        if self._landmarks is not None:
            return lost <= self.config.patience or lost % 2 == 0 or waited >= LONG_WAIT
        return lost == 0 or _is_power_of_two(lost)

    def _relocalized(self, frame: Frame, predicted: SE3 | None, lost: int, seed: int) -> Localization | None:
        """Search for the pose of a frame, by landmarks alone if the map has any; None if none was found.

        The search of the whole surface, which takes longer, runs at increasing intervals. ``lost`` is the number of searchable
        frames since the last accepted pose, 0 at the beginning of a sequence.
        """
        if self._landmarks is not None:
            assert self.localizer.matcher is not None
            began = clocks.perf_counter()
            problem = replace(self.localizer.problem(frame), sensor=self.localizer.depth_sensor)
            answer = Loop(problem.views, self.localizer.matcher, problem, seed=seed)()
            found = unrecognized(problem) if answer is None else localization_of(problem, answer, began)
            if self.localizer.shared.risk is not None:
                found = within_risk(found, self.localizer.shared.risk)
            due = lost == 0 or (lost % FIRST_FULL_SEARCH == 0 and _is_power_of_two(lost // FIRST_FULL_SEARCH))
            if found.converged or not due or self._scene.surface is None or not shows_shape(frame):
                return found
        try:
            return self.localizer.solved(self.localizer.problem(frame, predicted), seed)
        except InputError:
            if lost:  # the sequence has begun, so the frame is at fault, not the map or the settings
                return None
            raise

    def _reach(self, frame: Frame) -> float:
        """Return the distance (metres) to what the camera sees."""
        depth = frame.depth
        return (
            float(depth[depth > 0].median())
            if depth is not None and shows_shape(frame)
            else 0.3 * self._extent
        )

    @property
    def _key(self) -> str:
        info: Any = getattr(self._scene, "info", None)
        return "" if info is None else str(info.weights)


def _is_power_of_two(number: int) -> bool:
    return number > 0 and number & (number - 1) == 0
