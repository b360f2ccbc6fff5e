"""What a frame says about its predicted pose: by landmarks, measured depth or rendered colours; and the verdict on the result."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics
from bidnerf_core.depth import DepthSensorModel
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import CORNERS_PER_INDEPENDENT, SE3, skew, update_between
from bidnerf_core.localization.accept import Evidence, judge
from bidnerf_core.localization.explanations import MOVE, SHARE_AS_MAP, SHARE_MOVING, STATED, TURN
from bidnerf_core.localization.loop import ANGLE, TOLERANCE
from bidnerf_core.localization.matching import log10_nfa
from bidnerf_core.localization.posterior import Posterior
from bidnerf_core.localization.problem import SceneMap
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.settings import LEAST_POINTS, TrackerConfig
from bidnerf_core.localization.terms.rays import ALONE, Rays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.localization.tracking.flow import Grey
from bidnerf_core.localization.tracking.keyframes import FRESH, Points, Recognition, threshold_of
from bidnerf_core.localization.tracking.motion import Motion, PoseEstimate, pixel_radius
from bidnerf_core.localization.tracking.state import TrackerState
from bidnerf_core.mapping import (
    DEPTH,
    MOTION,
    Features,
    LandmarkMap,
    Landmarks,
    N,
    Normal,
    P,
    Quadratic,
    States,
    Term,
    descend,
    log_evidence,
    measured_depth,
    prior,
    total,
)

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


@dataclass(frozen=True, eq=False)
class Measurer:
    """Corrects predicted poses by what frames show of one map, and judges them."""

    scene: SceneMap
    landmarks: LandmarkMap | None
    features: Features | None  # the detector of the map's keypoints
    sensor: DepthSensorModel
    config: TrackerConfig

    @torch.no_grad()
    def __call__(
        self, frame: Frame, image: Grey | None, state: TrackerState, predicted: Motion
    ) -> Measurement | None:
        """Correct a prediction by all that a frame shows; None if it shows nothing of the map.

        The landmarks that were tracked to this frame are used as long as they are enough; otherwise, landmarks are recognised
        around their pose or the prediction.
        """
        if self.landmarks is None or image is None:
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
        assert self.landmarks is not None
        assert self.features is not None
        here = _at(predicted.T_world_camera)
        radius = search_radius(frame, predicted)
        if tracked is not None and tracked.log10_nfa <= SIGNIFICANT_NFA and tracked.is_accurate:
            here, radius = tracked.states, 0.0
        if radius is None:
            return None
        seen = Recognition.of(frame, self.features, self.landmarks, here.T[0])
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
            assert self.landmarks is not None
            correlation = self.landmarks.correlation_of(len(points))
        camera = frame.intrinsics
        states = _at(points.nearby(camera, start))
        term = points.term(camera, states, correlation)
        return Fit(term.with_noise(states), term, points, camera)

    def _fused(self, frame: Frame, state: TrackerState, fit: Fit, predicted: Motion) -> Measurement:
        """Fuse landmarks with measured depth, and both with the prediction; then judge the pose.

        Whether the camera moved during the readout, and the effect of its intrinsics and of correlated errors, are determined in
        frames in which landmarks are recognised, and change little until the next one.
        """
        landmarks, points = self.landmarks, fit.points
        assert landmarks is not None
        moving = max(SHARE_MOVING, SHARE_AS_MAP * landmarks.moving)
        deviation = torch.zeros((2, N), dtype=torch.float64)
        deviation[1, MOTION] = torch.tensor([MOVE * fit.distance] * 3 + [TURN] * 3, dtype=torch.float64)
        deviation[:, DEPTH] = 2 * self.sensor.scale
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
        surface, sensor = self.scene.surface, self.sensor
        if surface is None or not shows_shape(frame):
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
        assert self.landmarks is not None
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
            noise_ratio=state.noise / self.landmarks.noise, precision=_position_deviation(covariance) / fit.distance,
            mass=fused.mass(fit.distance, 0 * covariance, TOLERANCE, ANGLE, one > 0),
            other_place=0.0, credible=1.0, replaced=0.0, searched=True,
        )  # fmt: skip
        verdict = judge(evidence, 0.0 if state.searchable else FOLLOWS)
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
            self.scene.surface,
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
            drawn = Rays.of([view], self.scene.field, self.scene.bounds, RAYS, state.frames)
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
        typical = 0.0 if self.landmarks is None else self.landmarks.trial.translation
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

    def odometry(
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


def search_radius(frame: Frame, predicted: Motion) -> float | None:
    """Return the radius (pixels) within which landmarks very likely project; None if that is most of the image."""
    camera = frame.intrinsics
    radius = INLIER * pixel_radius(predicted.covariance, camera.fx, predicted.reach)
    return radius if radius <= WIDEST * math.hypot(camera.width, camera.height) else None


def shows_shape(frame: Frame) -> bool:
    """Return whether the frame has enough measured depth for the shape of the scene to be recognised."""
    return frame.depth is not None and int((frame.depth > 0).sum()) >= LEAST_POINTS


def _at(T: SE3) -> States:
    """Return the state of the stated camera at rest at one pose."""
    return States.known(T, torch.zeros(6, dtype=torch.float64))


def _position_deviation(covariance: Float[Tensor, "6 6"]) -> float:
    """Return the standard deviation (metres) of the position along its least certain direction, infinite if unknown."""
    if not bool(covariance.isfinite().all()):
        return math.inf
    return float(torch.linalg.eigvalsh(covariance[:3, :3])[-1].clamp(min=0).sqrt())
