"""Correction of a frame's predicted pose by landmarks, measured depth or rendered colours; and the verdict on the corrected pose."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from bidnerf_core.depth import DepthSensorModel
from bidnerf_core.fields import has_field
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import CORNERS_PER_INDEPENDENT, SE3, skew, update_between
from bidnerf_core.localization.accept import Evidence, Support, judge, keeps_bound
from bidnerf_core.localization.auto import within_limits
from bidnerf_core.localization.explanations import STATED, Explanations, motion_prior
from bidnerf_core.localization.loop import DEPTH_WIDTH
from bidnerf_core.localization.matching import (
    CELLS,
    Projected,
    QueryKeypoints,
    cells,
    log10_nfa,
)
from bidnerf_core.localization.modes import RADII
from bidnerf_core.localization.posterior import TOLERANCE, Posterior, fit_modes, mass_within
from bidnerf_core.localization.problem import SceneMap
from bidnerf_core.localization.propose import LEAST_AGREEING, consensus_near, landmarks_near, search_radius
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import LEAST_POINTS
from bidnerf_core.localization.terms.rays import ALONE, RenderedRays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.localization.tracking.motion import Motion, PoseEstimate, symmetric_root
from bidnerf_core.localization.tracking.points import POINTS, Fit, Grey, Points
from bidnerf_core.localization.tracking.state import TrackerState
from bidnerf_core.mapping import (
    DEPTH,
    MOTION,
    CostTerm,
    Features,
    GaussianPrior,
    LandmarkMap,
    N,
    Normal,
    P,
    States,
    damped_solution,
    descend,
    log_evidence,
    measured_depth,
    total,
)

ENOUGH_LANDMARKS = 40
"""Minimum number of tracked inliers: with fewer, landmarks are recognised anew, and a pose by tracked ones alone is rejected."""
LEAST_CORNERS = 20
"""Minimum number of corners that agree on a motion; at least half of all must, so that it is never by chance."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """The result of measuring a frame: the motion, the answer with its verdict, and the state for the next frame."""

    motion: Motion  # fused with the prediction
    answer: Localization  # its path leads from the prediction to the pose
    state: TrackerState  # with the points of this frame

    @staticmethod
    def of(
        predicted: Motion, motion: Motion, verdict: Verdict, loss: float, state: TrackerState, evidence: Any = None
    ) -> Measurement:
        path, losses = SE3.stack([predicted.T_world_camera, motion.T_world_camera]), torch.tensor([loss]).double()
        answer = Localization.of(verdict, path, losses, "track", time.perf_counter(), loss, motion.covariance, evidence)
        return Measurement(motion, answer, state)


@dataclass(frozen=True, eq=False)
class Determined:
    """A term of measured points, without the pose directions that the points constrain far more weakly than others.

    Points slide along flat walls at no cost; in a corridor, the few points on door frames and edges fit wrong places about as well
    as the right place (solution remapping, Zhang et al. 2016, "On degeneracy of optimization-based state estimation problems").
    """

    term: Surface

    def __call__(self, states: States) -> Normal:
        found, points = self.term(states), self.term.points.cpu()
        middle = points.median(0).values
        size = float((points - middle).square().sum(-1).mean().sqrt())
        # Converts the motion of the points' middle, and the rotation times the points' size, to a camera update.
        about = torch.eye(P, dtype=torch.float64)
        about[:3, 3:6] = skew(middle)
        about[:, 3:6] /= size
        values, axes = torch.linalg.eigh((about.T @ found.hessian[0] @ about)[:6, :6])
        good = torch.eye(P, dtype=torch.float64)
        # Along directions with less than a tenth of the mean information of the three best ones, the prediction is kept.
        good[:6, :6] = axes @ (axes * (values >= 0.1 * values[3:].mean())).T
        determined = about @ good @ torch.linalg.inv(about)
        return Normal(found.cost, found.gradient @ determined, determined.T @ found.hessian @ determined)


@dataclass(frozen=True, eq=False)
class Measurer:
    """Corrects predicted poses by comparing frames with one map, and judges the corrected poses."""

    scene: SceneMap
    landmarks: LandmarkMap | None
    features: Features | None  # the detector of the map's keypoints
    sensor: DepthSensorModel
    config: Any  # settings of the localizer, whose limits apply

    @torch.no_grad()
    def __call__(self, frame: Frame, image: Grey | None, state: TrackerState, predicted: Motion) -> Measurement | None:
        """Correct a prediction by all measurements of a frame; None if the frame shows nothing of the map.

        Landmarks tracked to this frame are used as long as there are enough; otherwise, landmarks are recognised anew around the pose
        of the tracked landmarks or around the prediction.
        """
        if self.landmarks is None or image is None:
            measured = self._by_surface(frame, image, state, predicted)
        else:
            measured = self._by_known(self.landmarks, frame, replace(state, age=state.age + 1), predicted)
        return measured if measured is None else replace(measured, answer=within_limits(measured.answer, self.config))

    def _by_known(
        self, landmarks: LandmarkMap, frame: Frame, state: TrackerState, predicted: Motion
    ) -> Measurement | None:
        known, fit, tracked, usable = state.points.landmarks, None, None, False
        if len(known) >= LEAST_AGREEING:
            correlation = landmarks.correlation_of(len(known))
            fit = Fit.of(known, frame.intrinsics, predicted.T_world_camera, correlation)
            count = int(fit.is_inlier.sum())
            # No pose counts that has fewer tracked landmarks, or that they fit hardly better than by chance.
            usable = count >= ENOUGH_LANDMARKS and fit.is_accurate
            # Landmarks are recognised anew every 20 frames, and once fewer than half of them are left, unless many are.
            if usable and count >= min(0.5 * state.sought, 125) and state.age < 20:
                tracked = self._by_landmarks(landmarks, frame, state, fit, predicted)
                if tracked.answer.converged:
                    return tracked
        recognised = self._recognise(landmarks, frame, predicted, fit)
        anew = None if recognised is None else self._by_landmarks(landmarks, frame, state, recognised, predicted)
        if fit is None or not usable or (anew is not None and anew.answer.converged):
            return anew
        tracked = tracked or self._by_landmarks(landmarks, frame, state, fit, predicted)
        return tracked if anew is None or tracked.answer.converged else anew

    def _recognise(self, known: LandmarkMap, frame: Frame, predicted: Motion, tracked: Fit | None) -> Fit | None:
        """Fit a pose to landmarks recognised around the pose of the tracked landmarks, or else around the prediction."""
        assert self.features is not None
        camera, T = frame.intrinsics, predicted.T_world_camera
        radius = search_radius(camera, predicted.covariance, predicted.reach)
        if tracked is not None and keeps_bound("log10_nfa", tracked.log10_nfa) and tracked.is_accurate:
            T, radius = tracked.states.T[0], 0.0
        if radius is None:
            return None
        query = QueryKeypoints.of([View(frame, SE3.identity())], self.features)
        still = torch.zeros(6, dtype=torch.float64)
        # Around an accurate pose, this radius of matching by projection suffices.
        tight = RADII[1] * query.threshold
        if radius > RADII[0] * query.threshold:
            # Matching by projection would compare a keypoint only with the few landmarks nearest to it; compare it with all in view.
            proposed = consensus_near(query, known, T, radius)
            if proposed is None:
                return None
            T = proposed[0].T
        number, fit = landmarks_near(query, known, T, radius), None
        landmarks = known[number]
        for within in (max(tight, min(radius, RADII[0] * query.threshold)), tight)[radius == 0 :]:
            seen = Projected(query, landmarks, States.known(T, still), within)
            matches = seen.matches(within)
            if len(matches) < LEAST_AGREEING:
                return None
            points = Points.of_landmarks(known, number[matches.landmark], query.keypoints.pixels[matches.keypoint])
            fit = Fit.of(points, camera, T, known.correlation_of(len(points)))
            fit = replace(fit, keypoints=len(query.view), by_chance=len(seen.matches(tight, 4 * tight)))
            T = fit.states.T[0]
        return fit

    def _by_landmarks(
        self, landmarks: LandmarkMap, frame: Frame, state: TrackerState, fit: Fit, predicted: Motion
    ) -> Measurement:
        """Fuse landmarks with measured depth, and both with the prediction; then judge the pose.

        Whether the camera moved during the readout, and the effects of its intrinsics and of correlated errors, are estimated only in
        frames in which landmarks are recognised; they change little until the next such frame.
        """
        scatter = pad(landmarks.calibration_scatter, (0, N - 4))
        moving, motion_deviation = motion_prior(landmarks, fit.term.distance(fit.states))
        deviation = torch.zeros((2, N), dtype=torch.float64)
        deviation[1, MOTION] = torch.tensor(motion_deviation, dtype=torch.float64)
        deviation[:, DEPTH] = DEPTH_WIDTH * self.sensor.scale
        log_prior = torch.tensor([1 - moving, moving], dtype=torch.float64).log()
        both = torch.tensor([False, True])
        given = Explanations(
            ("exact", "exact"), both, 0 * deviation, deviation, log_prior, torch.ones(2, dtype=torch.bool), scatter
        )
        states, rounds = given.about(fit.states), 2
        if not fit.is_recognised:
            states, rounds = states[int(state.moves) :][:1], 1 + state.moves
        depth, factor = self._depth(frame, state, fit.points, fit.states)
        term = fit.term.weighted_for(fit.states)
        terms: list[CostTerm] = [term] if depth is None else [term, depth.fitted_noise(fit.states)]
        # Gauss-Newton steps, each exact except for the robust weights, take half of the time of ``descend``.
        for number in range(rounds):
            # Depth hardly changes these weights, but a pose by few landmarks may be far off without depth.
            is_last = fit.is_recognised or number == rounds - 1
            normal = total(states, terms if is_last else terms[:1])
            states = states.retract(-damped_solution(normal, torch.zeros_like(normal.cost)))
        best = log_evidence(states, normal).argmax()[None]
        here, covariance, doubt = states[best], torch.linalg.inv_ex(normal.hessian[best])[0][0, :6, :6], state.doubt
        if fit.is_recognised:
            exact = torch.tensor(STATED[0][1:5], dtype=torch.float64)
            deviation[:, :4] = torch.hypot(exact, scatter[:4])  # the camera is free
            mixture = Posterior.of(fit_modes(here, terms, given, 0), term, scatter).mixture()
            if not bool((mixture + covariance).isfinite().all()):
                why = Verdict(Outcome.UNDETERMINED, "the landmarks do not determine the pose")
                return Measurement.of(predicted, predicted, why, float(here.noise), state)
            root = symmetric_root(mixture - covariance)
            doubt, state = root @ root, replace(state, moves=bool(here.row))
        # Errors that an image's landmarks share recur in the next image.
        covariance, share = covariance + doubt, 1 / float(term.correlation)
        shared = (1 - share) * covariance + landmarks.pose_covariance
        motion = predicted.update(PoseEstimate(here.T[0], share * covariance, shared))
        words = "" if depth is None else ", fused with depth"
        words = words if factor == 1 else f", without depth: it is {factor:.3g} times that of the landmarks"
        return self._judge(landmarks, replace(state, doubt=doubt), replace(fit, states=here), predicted, motion, words)

    def _depth(self, frame: Frame, state: TrackerState, points: Points, states: States) -> tuple[Surface | None, float]:
        """Return the term of the measured points, or None, and the ratio of their depth to that of the landmarks.

        There is no term without a surface or enough depth, or if the ratio is implausible; the ratio is 1 unless it is implausible.
        """
        surface, sensor = self.scene.surface, self.sensor
        if surface is None or not shows_shape(frame):
            return None, 1.0
        depth = measured_depth(frame, points.pixels)
        ratios = (states.T[0].inverse().apply(points.positions)[:, 2] / depth)[depth > 0]
        scale = float(ratios.median()) if len(ratios) >= LEAST_AGREEING else 1.0
        # Depth is wrong if its scale is five standard deviations from that of the landmarks, which a few determine to 1 %.
        if abs(scale - 1) > 5.0 * math.hypot(DEPTH_WIDTH * sensor.scale, 0.01):
            return None, 1 / scale
        return Surface.of([View(frame, SE3.identity())], None, surface, state.frames, POINTS), 1.0

    def _judge(
        self, landmarks: LandmarkMap, state: TrackerState, fit: Fit, predicted: Motion, motion: Motion, words: str
    ) -> Measurement:
        """Judge a landmark-based pose after its fusion with the prediction; ``words`` are appended to the reason."""
        covariance, inliers, noise = motion.covariance, fit.points[fit.is_inlier], float(fit.states.noise)
        count, one, distance = len(inliers), torch.ones(1, dtype=torch.float64), fit.term.distance(fit.states)
        nfa, chance, recall = fit.log10_nfa, 0.0, count / len(fit.points)
        if fit.by_chance is not None:
            # The number expected by chance is estimated from few counts, hence at least a half.
            nfa = log10_nfa(fit.keypoints, count, min(0.5, max(0.5, fit.by_chance) / fit.keypoints))
            chance, recall = fit.by_chance, count / fit.keypoints
        evidence = Evidence(
            log10_nfa=nfa,
            inliers=count,
            by_chance=chance,
            recall=recall,
            spread=len(cells(inliers.pixels, fit.camera).unique()) / CELLS**2,
            noise_ratio=noise / landmarks.noise,
            precision=_position_deviation(covariance) / distance,
            mass=mass_within(one, torch.zeros((1, 6)).double(), covariance[None], TOLERANCE * distance),
            other_place=0.0,
            credible=1.0,
            replaced=0.0,
            searched=True,
        )
        # Prior log odds of 4 if no image was rejected before: one pose in fifty is wrong, far more than tracked sequences show.
        verdict = judge(evidence, 0.0 if state.searchable else 4.0)
        verdict = replace(verdict, reason=verdict.reason + words)
        if fit.is_recognised:
            inliers = inliers.spread(fit.camera, POINTS)
            state = replace(state, sought=len(inliers), age=0)
        return Measurement.of(predicted, motion, verdict, noise, replace(state, points=inliers), evidence)

    def _by_surface(
        self, frame: Frame, image: Grey | None, state: TrackerState, predicted: Motion
    ) -> Measurement | None:
        """Correct a prediction by measured points on the surface, or else by rendered colours; then judge the pose.

        In directions that these measurements do not constrain, such as along a corridor, the prediction is kept.
        """
        surface, views = self.scene.surface, [View(frame, SE3.identity())]
        reach, covariance = predicted.reach, predicted.covariance
        points = None if surface is None else Surface.of(views, None, surface, state.frames, POINTS)
        if points is None and (image is None or not has_field(self.scene.field)):
            return None
        spread = math.sqrt(float((covariance.diagonal() * torch.tensor([1.0] * 3 + [reach**2] * 3)).sum() / 3))
        # Measured points alone may correct a prediction that is uncertain by up to 0.35 of the distance to the scene.
        if image is None and spread > 0.35 * reach:
            why = "no colours were recorded, and the prediction is too uncertain for the shape"
            return Measurement.of(predicted, predicted, Verdict(Outcome.UNDETERMINED, why), 1.0, state)
        states = States.known(predicted.T_world_camera, torch.zeros(6, dtype=torch.float64))
        prediction = GaussianPrior(predicted.T_world_camera, torch.linalg.inv(covariance))
        if points is None:
            # In a map without landmarks, 256 rays are rendered for a frame. The start is close, so that few steps suffice.
            rays = RenderedRays.of(views, self.scene.field, self.scene.bounds, 256, state.frames)
            rays = replace(rays, independent=ALONE)
            for _ in range(2):
                states, normal = descend(states, [prediction, rays.fitted(states)], 2)
            share = float(rays.at(states, derivatives=False).agreement())
            measures: dict[str, float | None] = {"new_inliers": share}
            words = f"{share:.0%} of the rays have the rendered colours"
        else:
            points = replace(points, colour_weight=float(image is not None))
            # At first, the robust loss is three times as wide as suits the residuals. The start is close, so that few steps suffice.
            for wider in (3.0, 1.0):
                fitted = replace(points, noise=max(points.noise, spread)).fitted_noise(states)
                # This widens the basin of convergence and keeps the information.
                fitted = replace(fitted, noise=wider * fitted.noise, independent=points.independent * wider**2)
                term = Determined(fitted) if image is None else fitted
                states, normal = descend(states, [prediction, term], 2)
            # The inlier weight of a point is one half at a distance of four cells from the surface.
            near, alike = replace(points, noise=2 * points.surface.cell).inliers(states)
            share, colours = float(near.mean()), None if image is None else float((near * alike).mean())
            measures = {"on_surface": share, "colour_inliers": colours}
            words = f"{share:.0%} of the measured points lie on the surface"
        information = (normal - prediction(states)).hessian[0, :6, :6]
        motion = predicted.refine(states.T[0].polished(), information)
        deviation = _position_deviation(motion.covariance)
        moved = update_between(predicted.T_world_camera, motion.T_world_camera)
        measures |= {
            "innovation": float(moved @ torch.linalg.solve(covariance, moved)),
            "timed": None if image is not None else float(state.clock.stamped),
            "precision": deviation / reach,
        }
        # Without colours, the position is bounded in terms of the median error of the map's own images.
        if image is None and self.landmarks is not None and self.landmarks.trial.translation:
            measures["beside_images"] = deviation / self.landmarks.trial.translation
        measured = Support(measures, {"precision": TOLERANCE})
        verdict = measured.verdict("")
        reason = words if verdict.accepted else f"{words}, but {verdict.reason}"
        return Measurement.of(predicted, motion, replace(verdict, reason=reason), 1 - share, state, measured)

    def odometry(
        self, frame: Frame, corners: Points, motion: Motion, predicted: Motion, seconds: float
    ) -> tuple[Motion, Points] | None:
        """Return the motion predicted from corners with measured depth, and the corners that agree; None if too few agree."""
        if len(corners) < LEAST_CORNERS:
            return None
        fit = Fit.of(corners, frame.intrinsics, predicted.T_world_camera, CORNERS_PER_INDEPENDENT)
        few = fit.agreeing < max(LEAST_CORNERS, 0.5 * len(corners))
        relative, singular = torch.linalg.inv_ex(fit.term(fit.states).hessian[0, :6, :6])
        if few or bool(singular):
            return None
        relative = (relative + relative.T) / 2
        return motion.move(fit.states.T[0], relative, seconds), corners[fit.is_inlier]


def shows_shape(frame: Frame) -> bool:
    """Return whether the frame has enough measured depth to recognise the shape of the scene."""
    return frame.depth is not None and int((frame.depth > 0).sum()) >= LEAST_POINTS


def _position_deviation(covariance: Float[Tensor, "6 6"]) -> float:
    """Return the standard deviation (metres) of the position along its least certain direction; infinite if unknown."""
    if not bool(covariance.isfinite().all()):
        return math.inf
    return float(torch.linalg.eigvalsh(covariance[:3, :3])[-1].clamp(min=0).sqrt())
