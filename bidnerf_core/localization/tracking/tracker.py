"""``Tracker``: estimates the poses of a sequence's frames one by one, and reports immediately when it is lost."""

from __future__ import annotations

import math
import time as clocks
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import CORNERS_PER_INDEPENDENT, SE3, skew, update_between
from bidnerf_core.localization.accept import Evidence, accept
from bidnerf_core.localization.auto import localization_of, unrecognized, within_risk
from bidnerf_core.localization.by_surface import is_blank
from bidnerf_core.localization.explanations import MOVE, SHARE_AS_MAP, SHARE_MOVING, STATED, TURN
from bidnerf_core.localization.localizer import Localizer, Start, map_with_distances, start_pose
from bidnerf_core.localization.loop import ANGLE, TOLERANCE, Loop
from bidnerf_core.localization.matching import log10_nfa
from bidnerf_core.localization.posterior import Posterior
from bidnerf_core.localization.problem import SceneMap, unit_of
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import LEAST_POINTS, TrackerConfig
from bidnerf_core.localization.terms.rays import ALONE, Rays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.localization.tracking.flow import Grey
from bidnerf_core.localization.tracking.keyframes import FRESH, Points, Recognition, threshold_of
from bidnerf_core.localization.tracking.motion import Clock, Motion, PoseEstimate, pixel_radius
from bidnerf_core.localization.tracking.state import (
    CorrectedCamera,
    TrackerState,
    load_tracker_state,
    save_state,
)
from bidnerf_core.mapping import (
    DEPTH,
    MOTION,
    Landmarks,
    N,
    Normal,
    P,
    Quadratic,
    States,
    Term,
    descend,
    grey_image,
    log_evidence,
    measured_depth,
    prior,
    strongest,
    total,
)

METHOD = "track"
"""Method name of a tracker's poses."""
START = 0.03, 0.1
"""Standard deviations of a start of unknown uncertainty: fraction of the scene's extent, and radians."""
VELOCITY_KEPT = 0.6
"""Fraction of the velocity kept with each lost frame."""
STEPS = 2
"""Maximum number of steps of a descent, since the start is close."""
WIDER = 3.0, 1.0
"""Scales of the robust loss of measured points, in units of that which suits their residuals, of consecutive descents."""
LEAST_MATCHES = 6
"""Minimum number of points from which a pose is estimated."""
ENOUGH_LANDMARKS = 40
"""Minimum number of tracked inliers at which no new landmarks are needed, and the pose needs no confirmation."""
TIGHT = 1.5
"""Radius of matching by projection around an accurate pose, in units of the inlier threshold."""
WIDEST = 0.4
"""Maximum search radius around the predicted landmarks, as a fraction of the image's diagonal."""
INLIER = 3.0
"""Maximum deviation of an inlier, and of a landmark from its prediction, in standard deviations."""
PLAUSIBLE = 5.0
"""Deviation of the scale of measured depth from that of the landmarks beyond which the depth is wrong, in standard deviations."""
SCALE_NOISE = 0.01
"""Relative standard deviation of that scale by a few landmarks."""
VAGUE = 0.35
"""Maximum uncertainty of a prediction that measured points may correct, as a fraction of the distance to the scene."""
RAYS = 256
"""Number of rays rendered for a frame in a map without landmarks."""
COMMON = 0.5
"""Fraction of the variance of a pose by depth or rendered colours that is common to consecutive frames."""
WEAK = 0.1
"""Ratio to the mean information of the three best directions below which the prediction is kept along a direction."""
FORESEEN = 25.0
"""Maximum squared Mahalanobis distance between a prediction and an accepted pose by depth or rendered colours."""
JUDGED_CELLS = 4.0
"""Distance from the surface at which a point counts half, in cells of the surface's grid."""
ON_SURFACE, LIKE_SURFACE, LIKE_RENDERED = 0.85, 0.42, 0.93
"""Minimum fractions of the measured points on the surface, of those that also have its colour, and of the rays with the rendered
colours."""
PRECISION = 0.03
"""Maximum standard deviation of an accepted position, relative to the distance of the scene."""
TYPICAL_ERRORS = 4.5
"""Maximum standard deviation of a position without colours, in median errors of the map's own images."""
LEAST_CORNERS, LEAST_SHARE, SIGNIFICANT_NFA = 20, 0.5, -6.0
"""Minimum number and fraction of the corners that agree on a motion, and maximum log10 of its number of false alarms."""
FOLLOWS = 4.0
"""Log odds that a pose is right if none of an image was rejected before it: one in fifty is wrong, far more than tracked sequences
show.
"""
LEAST_CHANCE = 0.5
"""Lower limit of the number of points recognised by chance, since it is estimated from few counts."""
FIRST_FULL_SEARCH = 4
"""The number of lost frames after which the whole surface is searched, and again each time that number has doubled."""
LONG_WAIT = 0.25
"""Interval without a search, in seconds, after which every frame is searched, as such frames arrive slowly enough."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """The motion after a frame was measured, the verdict on it, and the state for the next frame."""

    motion: Motion  # fused with the prediction
    verdict: Verdict
    loss: float
    state: TrackerState  # with the points of this frame


@dataclass(frozen=True, eq=False)
class Fit:
    """The pose of a static camera that observes points."""

    states: States  # (1)
    term: Landmarks
    points: Points
    camera: Intrinsics
    keypoints: int = 0  # in the image, if the points were recognised in it
    by_chance: int | None = None  # points that would be recognised at a wrong pose; None if they were tracked

    @cached_property
    def _residuals(self) -> tuple[Float[Tensor, "m"], Float[Tensor, "m"]]:
        """The reprojection errors in standard deviations and in pixels."""
        squared, off, _ = self.term.residuals(self.states)
        return squared[0].sqrt(), off[0].norm(dim=-1)

    @property
    def is_inlier(self) -> Bool[Tensor, "m"]:
        return self._residuals[0] <= INLIER

    @property
    def is_recognised(self) -> bool:
        """Whether the points were recognised in this image, rather than tracked to it."""
        return self.by_chance is not None

    @property
    def inliers(self) -> int:
        return int(self.is_inlier.sum())

    @property
    def threshold(self) -> float:
        """The largest reprojection error at which a point agrees, pixels."""
        return threshold_of(self.camera)

    @property
    def agreeing(self) -> int:
        return int((self._residuals[1] <= self.threshold).sum())

    @property
    def log10_nfa(self) -> float:
        """The number of false alarms if each point is a match that would be anywhere in the image if it were wrong."""
        by_chance = min(0.5, math.pi * self.threshold**2 / (self.camera.width * self.camera.height))
        return log10_nfa(len(self.points), self.agreeing, by_chance)

    @property
    def is_accurate(self) -> bool:
        """Whether the points fit better than if spread evenly over a disc of radius ``threshold``, as after failed flow.

        These have a standard deviation of half that radius along each axis.
        """
        return float(self.states.noise) <= self.threshold / 2

    @property
    def distance(self) -> float:
        return float((self.points.positions - self.states.T.translation).norm(dim=-1).median())


@dataclass(frozen=True, eq=False)
class Determined:
    """A term of measured points without the directions of the pose that they determine far worse than others.

    Points slide along flat walls at no cost, and in a corridor, the few others, on door frames and edges, fit wrong places about as
    well as the right one (solution remapping, Zhang et al. 2016, "On degeneracy of optimization-based state estimation problems").
    """

    term: Surface

    def __call__(self, states: States) -> Normal:
        found = self.term(states)
        points = self.term.points.cpu()
        middle = points.median(0).values
        size = float((points - middle).square().sum(-1).mean().sqrt())
        # Motion of the points' middle, and rotation times their size, by an update of the camera.
        at_middle = torch.eye(P, dtype=torch.float64)
        at_middle[:3, 3:6] = -skew(middle)
        at_middle[3:6] *= size
        back = torch.linalg.inv(at_middle)
        values, axes = torch.linalg.eigh((back.T @ found.hessian[0] @ back)[:6, :6])
        good = torch.eye(P, dtype=torch.float64)
        good[:6, :6] = axes @ (axes * (values >= WEAK * values[3:].mean())).T
        kept = back @ good @ at_middle
        return Normal(found.cost, found.gradient @ kept, kept.T @ found.hessian @ kept)


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
        self._start = None if start is None else start_pose(start)
        matcher = localizer.matcher if localizer.matches_landmarks else None
        self._landmarks = None if matcher is None else matcher.landmarks
        self._features = None if matcher is None else strongest(matcher.features, self.config.keypoints)
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
        )  # fmt: skip
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
            moved = self._odometry(frame, points[points.landmark == FRESH], motion, predicted, seconds)
            if moved is not None:
                predicted, points, how = *moved, "odometry"
            state = replace(state, points=points)
        measured = self.measure(frame, image, state, predicted)
        if measured is not None and measured.verdict.accepted:
            return self._answer(measured, predicted), self._after(frame, image, measured)
        if image is None and measured is not None:  # the shape still corrects some directions
            state = replace(state, motion=measured.motion, lost=state.lost + 1)
            return self._answer(measured, predicted), state
        if state.lost or self._radius(frame, predicted) is None:
            T, waited = predicted.T_world_camera, state.waited + abs(seconds)
            lost, found = max(state.searchable, min(state.lost, 1)), None
            if self._is_search_due(frame, lost, waited):
                found = self._relocalized(frame, T, lost, state.frames)
                waited = waited if image is None else 0.0  # a frame with depth alone shows no landmarks
            state = replace(state, waited=waited)
            if image is not None and found is not None and found.converged:
                return self._found(frame, image, state, found)
        searchable = image is not None and (self._has_points(frame) or not is_blank(frame))
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
        measured = self.measure(frame, image, state, motion)
        if measured is not None and measured.verdict.accepted:
            reason = f"{reason}; {measured.verdict.reason}"
        else:
            measured = Measurement(motion, Verdict(found.outcome, found.reason), found.loss, state)
        state = self._after(frame, image, replace(measured, motion=motion))
        return replace(found, reason=reason, covariance=motion.covariance), state

    # Measuring.

    @torch.no_grad()
    def measure(
        self, frame: Frame, image: Grey | None, state: TrackerState, predicted: Motion
    ) -> Measurement | None:
        """Correct a prediction by all that a frame shows; None if it shows nothing of the map.

        The landmarks that were tracked to this frame are used as long as they are enough; otherwise, landmarks are recognised
        around their pose or the prediction.
        """
        if self._landmarks is None or image is None:
            return self._rendered(frame, image, state, predicted)
        state = replace(state, age=state.age + 1)
        known, here, tracked = state.points[state.points.landmark != FRESH], None, None
        if len(known) >= LEAST_MATCHES:
            here = self._fit(frame, known, predicted.T_world_camera)
            enough = max(ENOUGH_LANDMARKS, self.config.refresh_share * state.sought)
            if here.inliers >= enough and state.age < self.config.refresh_frames:
                tracked = self._fused(frame, state, here, predicted)
                if tracked.verdict.accepted:
                    return tracked
        seen = self._recognised(frame, state, predicted, here)
        if here is None or (seen is not None and seen.verdict.accepted):
            return seen
        tracked = self._fused(frame, state, here, predicted) if tracked is None else tracked
        if seen is not None and not tracked.verdict.accepted:
            return seen
        if tracked.verdict.accepted and len(tracked.state.points) < ENOUGH_LANDMARKS:
            why = f"{tracked.verdict.reason}, but the image does not confirm these few tracked ones"
            return replace(tracked, verdict=Verdict(Outcome.TOO_FEW_MATCHES, why))
        return tracked

    def _recognised(
        self, frame: Frame, state: TrackerState, predicted: Motion, tracked: Fit | None
    ) -> Measurement | None:
        """Measure by landmarks recognised around the pose of the tracked ones, or else around the prediction."""
        assert self._landmarks is not None
        assert self._features is not None
        here = _at(predicted.T_world_camera)
        radius = self._radius(frame, predicted)
        if tracked is not None and tracked.log10_nfa <= SIGNIFICANT_NFA and tracked.is_accurate:
            here, radius = tracked.states, 0.0
        if radius is None:
            return None
        seen = Recognition.of(frame, self._features, self._landmarks, here.T[0])
        tight = TIGHT * seen.query.threshold
        if radius > 2 * tight:
            proposal = seen.proposal(here, radius)
            if proposal is None:
                return None
            here = replace(here, T=proposal[None])
        if radius > 0:
            points = seen.near(here, max(tight, min(radius, 2 * tight)))[0]
            if len(points) < LEAST_MATCHES:
                return None
            here = self._fit(frame, points, here.T[0]).states
        points, by_chance = seen.near(here, tight)
        if len(points) < LEAST_MATCHES:
            return None
        fit = replace(
            self._fit(frame, points, here.T[0]),
            keypoints=len(seen.query.view),
            by_chance=by_chance,
        )
        return self._fused(frame, state, fit, predicted)

    def _fit(self, frame: Frame, points: Points, start: SE3, correlation: float | None = None) -> Fit:
        """Fit the pose of a static camera to points, by default landmarks, from a start."""
        if correlation is None:
            assert self._landmarks is not None
            correlation = self._landmarks.correlation_of(len(points))
        camera = frame.intrinsics
        states = _at(points.nearby(camera, start))
        term = points.term(camera, states, correlation)
        return Fit(term.with_noise(states), term, points, camera)

    def _fused(self, frame: Frame, state: TrackerState, fit: Fit, predicted: Motion) -> Measurement:
        """Fuse landmarks with measured depth, and both with the prediction; then judge the pose.

        Whether the camera moved during the readout, and the effect of its intrinsics and of correlated errors, are determined in
        frames in which landmarks are recognised, and change little until the next one.
        """
        landmarks, points = self._landmarks, fit.points
        assert landmarks is not None
        moving = max(SHARE_MOVING, SHARE_AS_MAP * landmarks.moving)
        deviation = torch.zeros((2, N), dtype=torch.float64)
        deviation[1, MOTION] = torch.tensor([MOVE * fit.distance] * 3 + [TURN] * 3, dtype=torch.float64)
        deviation[:, DEPTH] = 2 * self.localizer.depth_sensor.scale
        rows = torch.tensor([0, 1] if fit.is_recognised else [int(state.moves)])
        log_prior = torch.tensor([1 - moving, moving], dtype=torch.float64).log()
        states = replace(
            fit.states[torch.zeros_like(rows)], deviation=deviation[rows], row=rows, log_prior=log_prior[rows]
        )
        term = fit.term.weighted_for(fit.states)
        depth, objection = self._depth(frame, state, points, fit.states)
        words = "" if depth is None else ", fused with depth"
        words = f", without depth: {objection}" if objection else words
        steps, here = 2 if int(rows.sum()) else self.config.depth_steps, fit.states
        # Depth is linearized, as it hardly changes in these steps; few landmarks may be far off without it.
        for _ in range(2 if fit.is_recognised and depth is not None else 1):
            terms: list[Term] = [term]
            if depth is not None:
                free = replace(here, deviation=deviation[1:])
                terms.append(Quadratic.of(depth.fitted_noise(here)(free), free))
            states, normal = descend(states, terms, steps)
            best = int(log_evidence(states, normal).argmax())
            here = states[best : best + 1]
        states, doubt = here, state.doubt
        covariance = torch.linalg.inv_ex(normal.hessian[best])[0][:6, :6]
        if fit.is_recognised:
            scatter = landmarks.calibration_scatter.double()
            focal, centre, k1 = (STATED[0][n] for n in (1, 2, 3))
            exact = torch.tensor([focal, centre, centre, k1], dtype=torch.float64)
            deviation[:, :4] = torch.hypot(exact, scatter)
            free = replace(states, deviation=deviation[1:])
            whole = Quadratic.of(total(free, terms) - prior(free), free)
            both = torch.zeros(2, dtype=torch.long)
            rivals = replace(
                free[both], z=torch.where(deviation > 0, free.z, 0), deviation=deviation, log_prior=log_prior
            )
            found = Posterior.of(rivals, whole, term, scatter)
            excess, axes = torch.linalg.eigh(found.mixture() - covariance)
            doubt, covariance = (axes * excess.clamp(min=0)) @ axes.T, found.mixture()
        else:
            covariance = covariance + doubt
        # Errors that an image's landmarks share recur in the next image.
        share = 1 / float(term.correlation)
        shared = (1 - share) * covariance + landmarks.pose_covariance
        motion = predicted.updated(PoseEstimate(states.T[0], share * covariance, shared))
        state = replace(state, noise=float(states.noise), moves=bool(states.row), doubt=doubt)
        return self._judged(state, replace(fit, states=states), motion, words)

    def _depth(
        self, frame: Frame, state: TrackerState, points: Points, states: States
    ) -> tuple[Surface | None, str]:
        """Return the measured points as a term, or why they are not used."""
        surface, sensor = self._scene.surface, self.localizer.depth_sensor
        if surface is None or not self._has_points(frame):
            return None, ""
        depth = measured_depth(frame, points.pixels)
        ratio = states.T[0].inverse().apply(points.positions)[:, 2] / depth
        ratio = ratio[depth > 0]
        if len(ratio) >= LEAST_MATCHES:
            scale = float(ratio.median())
            if abs(scale - 1) > PLAUSIBLE * math.hypot(2 * sensor.scale, SCALE_NOISE):
                return None, f"it is {1 / scale:.3g} times that of the landmarks"
        view = View(frame, SE3.identity())
        return Surface.of([view], None, surface, state.frames, self.config.depth_points), ""

    def _judged(self, state: TrackerState, fit: Fit, motion: Motion, words: str) -> Measurement:
        """Judge a pose by landmarks, after its fusion with the prediction."""
        assert self._landmarks is not None
        covariance, count, kept = motion.covariance, fit.inliers, fit.points[fit.is_inlier]
        if fit.by_chance is None:
            nfa, chance, recall = fit.log10_nfa, 0.0, count / len(fit.points)
        else:
            nfa = log10_nfa(fit.keypoints, count, min(0.5, max(LEAST_CHANCE, fit.by_chance) / fit.keypoints))
            chance, recall = fit.by_chance, count / fit.keypoints
        one = torch.ones(1, dtype=torch.float64)
        fused = Posterior(
            fit.states, Normal(one, one, one), one, covariance[None], torch.zeros((1, 6)).double(), one, 0
        )
        evidence = Evidence(
            log10_nfa=nfa, inliers=count, by_chance=chance, recall=recall, spread=kept.spread(fit.camera),
            noise_ratio=state.noise / self._landmarks.noise, precision=_position_deviation(covariance) / fit.distance,
            mass=fused.mass(fit.distance, 0 * covariance, TOLERANCE, ANGLE, one > 0),
            other_place=0.0, credible=1.0, replaced=0.0, searched=True,
        )  # fmt: skip
        verdict = accept(evidence, 0.0 if state.searchable else FOLLOWS)
        if verdict.accepted and not fit.is_recognised and not fit.is_accurate:
            verdict = Verdict(Outcome.AMBIGUOUS, f"{verdict.reason}, hardly better than by chance")
        if fit.is_recognised:
            kept = kept.well_spread(fit.camera, self.config.points)
            state = replace(state, sought=len(kept), age=0)
        verdict = replace(verdict, reason=verdict.reason + words)
        return Measurement(motion, verdict, state.noise, replace(state, points=kept))

    def _rendered(
        self, frame: Frame, image: Grey | None, state: TrackerState, predicted: Motion
    ) -> Measurement | None:
        """Correct a prediction by measured points on the surface, or else by rendered colours.

        Along directions that these do not determine, such as that of a corridor, the prediction remains.
        """
        surface, view, states = (
            self._scene.surface,
            View(frame, SE3.identity()),
            _at(predicted.T_world_camera),
        )
        reach, covariance = predicted.reach, predicted.covariance
        term: Surface | Rays | None = None
        translation, rotation = covariance.diagonal().split(3)
        off = math.sqrt(float(translation.mean() + rotation.mean() * reach**2))
        if surface is not None:
            term = Surface.of([view], None, surface, state.frames, self.config.depth_points)
        if isinstance(term, Surface) and image is not None:
            term = replace(term, colour_weight=1.0)
        elif term is None and image is not None:
            drawn = Rays.of([view], self._scene.field, self._scene.bounds, RAYS, state.frames)
            term = replace(drawn, independent=ALONE)
        if term is None:
            return None
        if image is None and off > VAGUE * reach:
            why = "no colours were recorded, and the prediction is too uncertain for the shape"
            return Measurement(predicted, Verdict(Outcome.UNDETERMINED, why), 1.0, state)
        zero, hessian = torch.zeros((1, P), dtype=torch.float64), torch.zeros((1, P, P), dtype=torch.float64)
        hessian[0, :6, :6] = torch.linalg.inv(covariance)
        prediction = Quadratic(states, zero[:, 0], zero, hessian)
        for wider in WIDER:
            here: Term
            if isinstance(term, Surface):
                fitted = replace(term, noise=max(term.noise, off)).fitted_noise(states)
                independent = term.independent * wider**2  # the same information from a wider basin
                fitted = replace(fitted, noise=wider * fitted.noise, independent=independent)
                here = Determined(fitted) if image is None else fitted
            else:
                here = term.fitted(states)
            states, normal = descend(states, [prediction, here], STEPS)
        information = normal.hessian[0, :6, :6] - hessian[0, :6, :6]
        fused = torch.linalg.inv(normal.hessian[0, :6, :6])
        kept, measured = torch.eye(6).double() - fused @ information, fused @ information @ fused
        pose = PoseEstimate(
            states.T[0].polished(),
            kept @ predicted.noise[:6, :6] @ kept.T + (1 - COMMON) * measured,
            kept @ predicted.bias @ kept.T + COMMON * measured,
        )
        moved = update_between(predicted.T_world_camera, pose.T_world_camera)
        surprise = float(moved @ torch.linalg.solve(covariance, moved))
        return self._judged_on_surface(state, term, states, predicted.refined(pose), surprise)

    def _judged_on_surface(
        self, state: TrackerState, term: Surface | Rays, states: States, motion: Motion, surprise: float
    ) -> Measurement:
        """Judge a pose by measured points on the surface or by rendered colours."""
        deviation, by_shape = _position_deviation(motion.covariance), False
        typical = 0.0 if self._landmarks is None else self._landmarks.trial.translation
        if isinstance(term, Surface):
            by_shape = not term.colour_weight
            near, alike = replace(term, noise=JUDGED_CELLS / 2 * term.surface.cell).inliers(states)
            share, colours = float(near.mean()), float((near * alike).mean())
            words = f"{share:.0%} of the measured points lie on the surface"
        else:
            share, colours = float(term.agreement(states)), 1.0
            words = f"{share:.0%} of the rays have the rendered colours"
        uncertain = f"{words}, but the position is uncertain by {deviation:.3g}"
        rows = [
            (by_shape or isinstance(term, Surface), share >= ON_SURFACE, Outcome.OFF_SURFACE, f"only {words}"),
            (isinstance(term, Rays), share >= LIKE_RENDERED, Outcome.RENDERING_MISMATCH, f"only {words}"),
            (not by_shape, colours >= LIKE_SURFACE, Outcome.COLOUR_MISMATCH, f"only {colours:.0%} have the surface's colour"),
            (True, surprise <= FORESEEN, Outcome.AMBIGUOUS, "the measurements fit a place that is inconsistent with the motion"),
            (by_shape, state.clock.stamped, Outcome.IMPRECISE, f"{words}, but without a time stamp the motion is unknown"),
            (True, deviation <= PRECISION * motion.reach, Outcome.IMPRECISE, uncertain),
            (by_shape and typical > 0, deviation <= TYPICAL_ERRORS * typical, Outcome.IMPRECISE, f"{uncertain}, images by {typical:.3g}"),
        ]  # fmt: skip
        for applies, passed, outcome, why in rows:
            if applies and not passed:
                return Measurement(motion, Verdict(outcome, why), 1 - share, state)
        return Measurement(motion, Verdict(Outcome.CONVERGED, words), 1 - share, state)

    def _odometry(
        self, frame: Frame, corners: Points, motion: Motion, predicted: Motion, seconds: float
    ) -> tuple[Motion, Points] | None:
        """Return the prediction by corners with measured depth, and those that agree; None if these are too few."""
        if len(corners) < LEAST_CORNERS:
            return None
        fit = self._fit(frame, corners, predicted.T_world_camera, CORNERS_PER_INDEPENDENT)
        few = fit.agreeing < max(LEAST_CORNERS, LEAST_SHARE * len(corners))
        relative, singular = torch.linalg.inv_ex(fit.term(fit.states).hessian[0, :6, :6])
        if few or fit.log10_nfa > SIGNIFICANT_NFA or bool(singular):
            return None
        relative = (relative + relative.T) / 2
        return motion.moved(fit.states.T[0], relative, seconds), corners[fit.is_inlier]

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
        if not self._has_points(frame) and is_blank(frame):
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
            if found.converged or not due or self._scene.surface is None or not self._has_points(frame):
                return found
        try:
            return self.localizer(frame, predicted, seed=seed)
        except InputError:
            if lost:  # the sequence has begun, so the frame is at fault, not the map or the settings
                return None
            raise

    def _radius(self, frame: Frame, predicted: Motion) -> float | None:
        """Return the radius (pixels) within which landmarks very likely project; None if that is most of the image."""
        camera = frame.intrinsics
        radius = INLIER * pixel_radius(predicted.covariance, camera.fx, predicted.reach)
        return radius if radius <= WIDEST * math.hypot(camera.width, camera.height) else None

    def _reach(self, frame: Frame) -> float:
        """Return the distance (metres) to what the camera sees."""
        depth = frame.depth
        return (
            float(depth[depth > 0].median())
            if depth is not None and self._has_points(frame)
            else 0.3 * self._extent
        )

    @staticmethod
    def _has_points(frame: Frame) -> bool:
        """Return whether the frame has enough measured depth for the shape of the scene to be recognised."""
        return frame.depth is not None and int((frame.depth > 0).sum()) >= LEAST_POINTS

    @property
    def _key(self) -> str:
        info: Any = getattr(self._scene, "info", None)
        return "" if info is None else str(info.weights)


def _at(T: SE3) -> States:
    """Return the state of the stated camera at rest at one pose."""
    return States.known(T, torch.zeros(6, dtype=torch.float64))


def _position_deviation(covariance: Float[Tensor, "6 6"]) -> float:
    """Return the standard deviation (metres) of the position along its least certain direction, infinite if unknown."""
    if not bool(covariance.isfinite().all()):
        return math.inf
    return float(torch.linalg.eigvalsh(covariance[:3, :3])[-1].clamp(min=0).sqrt())


def _is_power_of_two(number: int) -> bool:
    return number > 0 and number & (number - 1) == 0
