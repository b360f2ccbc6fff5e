"""Correction of a frame's predicted pose by landmarks, measured depth or rendered colours; and the verdict on the corrected pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.depth import DepthSensorModel
from bidnerf_core.fields import has_field
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import CORNERS_PER_INDEPENDENT, SE3, skew, update_between
from bidnerf_core.localization.accept import Evidence, Support, judge
from bidnerf_core.localization.explanations import STATED, motion_prior
from bidnerf_core.localization.loop import DEPTH_WIDTH
from bidnerf_core.localization.matching import (
    CELLS,
    OBLIQUE,
    LandmarkMatcher,
    Matches,
    Nearest,
    Projected,
    QueryKeypoints,
    cells,
    log10_nfa,
)
from bidnerf_core.localization.posterior import TOLERANCE, Posterior, mass_within
from bidnerf_core.localization.problem import SceneMap
from bidnerf_core.localization.propose import LEAST_AGREEING, consensus
from bidnerf_core.localization.result import Outcome, Verdict
from bidnerf_core.localization.settings import LEAST_POINTS
from bidnerf_core.localization.terms.rays import ALONE, RenderedRays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.localization.tracking.motion import Motion, PoseEstimate, pixel_radius
from bidnerf_core.localization.tracking.points import INLIER, POINTS, Fit, Grey, Points
from bidnerf_core.localization.tracking.state import TrackerState
from bidnerf_core.mapping import (
    DEPTH,
    MOTION,
    CostTerm,
    Features,
    LandmarkMap,
    N,
    Normal,
    P,
    Quadratic,
    States,
    damped_solution,
    descend,
    log_evidence,
    measured_depth,
    prior,
    total,
)

ENOUGH_LANDMARKS = 40
"""Minimum number of tracked inliers: with fewer, landmarks are recognised anew, and a pose by tracked ones alone is rejected."""
LEAST_CORNERS, SIGNIFICANT_NFA = 20, -6.0
"""Minimum number of corners that agree on a motion (at least half of all must), and maximum log10 of the motion's false alarms."""


@dataclass(frozen=True, eq=False)
class Measurement:
    """The result of measuring a frame: the motion, the verdict on it, and the state for the next frame."""

    motion: Motion  # fused with the prediction
    verdict: Verdict
    loss: float
    state: TrackerState  # with the points of this frame


@dataclass(frozen=True, eq=False)
class Determined:
    """A term of measured points, without the pose directions that the points constrain far more weakly than others.

    Points slide along flat walls at no cost; in a corridor, the few points on door frames and edges fit wrong places about as well
    as the right place (solution remapping, Zhang et al. 2016, "On degeneracy of optimization-based state estimation problems").
    """

    term: Surface

    def __call__(self, states: States) -> Normal:
        found = self.term(states)
        points = self.term.points.cpu()
        middle = points.median(0).values
        size = float((points - middle).square().sum(-1).mean().sqrt())
        # Converts a camera update to the motion of the points' middle, and the rotation times the points' size.
        at_middle = torch.eye(P, dtype=torch.float64)
        at_middle[:3, 3:6] = -skew(middle)
        at_middle[3:6] *= size
        back = torch.linalg.inv(at_middle)
        values, axes = torch.linalg.eigh((back.T @ found.hessian[0] @ back)[:6, :6])
        good = torch.eye(P, dtype=torch.float64)
        # Along directions with less than a tenth of the mean information of the three best ones, the prediction is kept.
        good[:6, :6] = axes @ (axes * (values >= 0.1 * values[3:].mean())).T
        determined = back @ good @ at_middle
        return Normal(found.cost, found.gradient @ determined, determined.T @ found.hessian @ determined)


@dataclass(frozen=True, eq=False)
class Measurer:
    """Corrects predicted poses by comparing frames with one map, and judges the corrected poses."""

    scene: SceneMap
    landmarks: LandmarkMap | None
    features: Features | None  # the detector of the map's keypoints
    sensor: DepthSensorModel

    @torch.no_grad()
    def __call__(self, frame: Frame, image: Grey | None, state: TrackerState, predicted: Motion) -> Measurement | None:
        """Correct a prediction by all measurements of a frame; None if the frame shows nothing of the map.

        Landmarks tracked to this frame are used as long as there are enough; otherwise, landmarks are recognised anew around the pose
        of the tracked landmarks or around the prediction.
        """
        landmarks = self.landmarks
        if landmarks is None or image is None:
            return self._by_surface(frame, image, state, predicted)
        state = replace(state, age=state.age + 1)
        known, fit, tracked = state.points.landmarks, None, None
        if len(known) >= LEAST_AGREEING:
            correlation = landmarks.correlation_of(len(known))
            fit = Fit.of(known, frame.intrinsics, predicted.T_world_camera, correlation)
            # Landmarks are recognised anew every 20 frames, and once fewer than half of them are left, unless many are.
            enough = max(ENOUGH_LANDMARKS, min(0.5 * state.sought, 125))
            if int(fit.is_inlier.sum()) >= enough and state.age < 20:
                tracked = self._by_landmarks(landmarks, frame, state, fit, predicted)
                if tracked.verdict.accepted:
                    return tracked
        seen = self._recognised(landmarks, frame, predicted, fit)
        found = None if seen is None else self._by_landmarks(landmarks, frame, state, seen, predicted)
        if fit is None or (found is not None and found.verdict.accepted):
            return found
        tracked = tracked or self._by_landmarks(landmarks, frame, state, fit, predicted)
        return found if found is not None and not tracked.verdict.accepted else tracked

    def _recognised(self, known: LandmarkMap, frame: Frame, predicted: Motion, tracked: Fit | None) -> Fit | None:
        """Fit a pose to landmarks recognised around the pose of the tracked landmarks, or else around the prediction."""
        assert self.features is not None
        camera, T = frame.intrinsics, predicted.T_world_camera
        radius = search_radius(frame, predicted)
        if tracked is not None and tracked.log10_nfa <= SIGNIFICANT_NFA and tracked.is_accurate:
            T, radius = tracked.states.T[0], 0.0
        if radius is None:
            return None
        # Slopes of 0.5 times the size would have no margin.
        size = torch.tensor([camera.width / camera.fx, camera.height / camera.fy])
        number, _ = known.in_view(T, 0.6 * size, OBLIQUE)
        # Of the landmarks in view, the 4,000 that most images show are compared, regardless of where they project.
        order = known.views[number].argsort(descending=True, stable=True)
        number = number[order[:4_000].sort().values]
        query, landmarks = QueryKeypoints.of([View(frame, SE3.identity())], self.features), known[number]
        still = torch.zeros(6, dtype=torch.float64)

        def points_of(matches: Matches) -> Points:
            index = matches.landmark
            return Points(
                query.keypoints.pixels[matches.keypoint],
                landmarks.positions[index].double(),
                landmarks.deviations[index].double(),
                landmarks.directions[index].double(),
                number[index],
            )

        def near(within: float) -> tuple[Points, Projected]:
            seen = Projected(query, landmarks, States.known(T, still), within)
            return points_of(seen.matches(within)), seen

        # Around an accurate pose, this radius of matching by projection suffices.
        tight = 1.5 * query.threshold
        if radius > 2 * tight:
            # Matching by projection would compare a keypoint only with the few landmarks nearest to it; compare it with all in view.
            if len(landmarks) < 2 or len(query.view) < 4:
                return None
            matches = Nearest.of(query, LandmarkMatcher(landmarks), len(query.view)).best
            points = points_of(matches)
            off = camera.project(T.inverse().apply(points.positions)) - points.pixels
            some = (off.norm(dim=-1) <= radius).nonzero()[:, 0]  # NaN (behind the camera) is false
            found = consensus(query, landmarks, matches[some], still)
            if found is None:
                return None
            T = found[0].T
        if radius > 0:
            points, _ = near(max(tight, min(radius, 2 * tight)))
            if len(points) < LEAST_AGREEING:
                return None
            T = Fit.of(points, camera, T, known.correlation_of(len(points))).states.T[0]
        points, seen = near(tight)
        if len(points) < LEAST_AGREEING:
            return None
        chance = len(seen.matches(tight, 4 * tight))
        fit = Fit.of(points, camera, T, known.correlation_of(len(points)))
        return replace(fit, keypoints=len(query.view), by_chance=chance)

    def _by_landmarks(
        self, landmarks: LandmarkMap, frame: Frame, state: TrackerState, fit: Fit, predicted: Motion
    ) -> Measurement:
        """Fuse landmarks with measured depth, and both with the prediction; then judge the pose.

        Whether the camera moved during the readout, and the effects of its intrinsics and of correlated errors, are estimated only in
        frames in which landmarks are recognised; they change little until the next such frame.
        """
        points = fit.points
        distance = float((points.positions - fit.states.T.translation).norm(dim=-1).median())
        scatter = landmarks.calibration_scatter.double()
        moving, motion_deviation = motion_prior(landmarks, distance)
        log_prior = torch.tensor([1 - moving, moving], dtype=torch.float64).log()
        deviation = torch.zeros((2, N), dtype=torch.float64)
        deviation[1, MOTION] = torch.tensor(motion_deviation, dtype=torch.float64)
        deviation[:, DEPTH] = DEPTH_WIDTH * self.sensor.scale
        rows = torch.tensor([0, 1] if fit.is_recognised else [int(state.moves)])
        states = replace(fit.states[0 * rows], deviation=deviation[rows], row=rows, log_prior=log_prior[rows])
        depth, factor = self._depth(frame, state, points, fit.states)
        term = fit.term.weighted_for(fit.states)
        terms: list[CostTerm] = [term] if depth is None else [term, depth.fitted_noise(fit.states)]
        # Gauss-Newton steps, each exact except for the robust weights.
        # Depth hardly changes these weights, but a pose by few landmarks may be far off without depth.
        rounds = [terms] if not bool(rows.any()) else [terms if fit.is_recognised else [term], terms]
        for used in rounds:
            normal = total(states, used)
            step = damped_solution(normal, torch.zeros_like(normal.cost))
            normal = replace(normal, cost=normal.cost - (step * normal.gradient).sum(-1) / 2)
            states = states.retract(-step)
        best = int(log_evidence(states, normal).argmax()) if fit.is_recognised else 0
        covariance = torch.linalg.inv_ex(normal.hessian[best])[0][:6, :6]
        here, doubt = states[best : best + 1], state.doubt
        if fit.is_recognised:
            exact = torch.tensor(STATED[0][1:5], dtype=torch.float64)
            deviation[:, :4] = torch.hypot(exact, scatter)
            free = replace(here, deviation=deviation[1:])
            whole = Quadratic.of(total(free, terms) - prior(free), free)
            both = replace(
                free[0 * rows],
                z=torch.where(deviation > 0, free.z, 0),
                deviation=deviation,
                log_prior=log_prior,
            )
            mixture = Posterior.of(*whole.minimum(both), whole, term, scatter).mixture()
            excess, axes = torch.linalg.eigh(mixture - covariance)
            doubt, covariance = (axes * excess.clamp(min=0)) @ axes.T, mixture
        else:
            covariance = covariance + doubt
        # Errors that an image's landmarks share recur in the next image.
        share = 1 / float(term.correlation)
        shared = (1 - share) * covariance + landmarks.pose_covariance
        motion = predicted.updated(PoseEstimate(here.T[0], share * covariance, shared))
        state = replace(state, moves=bool(here.row), doubt=doubt)
        words = "" if depth is None else ", fused with depth"
        words = words if factor == 1 else f", without depth: it is {factor:.3g} times that of the landmarks"
        found = self._judged(landmarks, state, replace(fit, states=here), motion, distance)
        return replace(found, verdict=replace(found.verdict, reason=found.verdict.reason + words))

    def _depth(self, frame: Frame, state: TrackerState, points: Points, states: States) -> tuple[Surface | None, float]:
        """Return the term of the measured points, or None, and the ratio of their depth to that of the landmarks.

        There is no term without a surface or enough depth, or if the ratio is implausible; the ratio is 1 unless it is implausible.
        """
        surface, sensor = self.scene.surface, self.sensor
        if surface is None or not shows_shape(frame):
            return None, 1.0
        depth = measured_depth(frame, points.pixels)
        ratio = states.T[0].inverse().apply(points.positions)[:, 2] / depth
        ratio = ratio[depth > 0]
        if len(ratio) >= LEAST_AGREEING:
            scale = float(ratio.median())
            # Depth is wrong if its scale is five standard deviations from that of the landmarks, which a few determine to 1 %.
            if abs(scale - 1) > 5.0 * math.hypot(DEPTH_WIDTH * sensor.scale, 0.01):
                return None, 1 / scale
        view = View(frame, SE3.identity())
        return Surface.of([view], None, surface, state.frames, POINTS), 1.0

    def _judged(
        self, landmarks: LandmarkMap, state: TrackerState, fit: Fit, motion: Motion, distance: float
    ) -> Measurement:
        """Judge a landmark-based pose after its fusion with the prediction."""
        covariance, inliers, noise = motion.covariance, fit.points[fit.is_inlier], float(fit.states.noise)
        count, one = len(inliers), torch.ones(1, dtype=torch.float64)
        if fit.by_chance is None:
            nfa, chance, recall = fit.log10_nfa, 0.0, count / len(fit.points)
        else:
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
            mass=mass_within(one, torch.zeros((1, 6)).double(), covariance[None], distance),
            other_place=0.0,
            credible=1.0,
            replaced=0.0,
            searched=True,
        )
        # Prior log odds of 4 if no image was rejected before: one pose in fifty is wrong, far more than tracked sequences show.
        verdict = judge(evidence, 0.0 if state.searchable else 4.0)
        if fit.is_recognised:
            inliers = inliers.well_spread(fit.camera, POINTS)
            state = replace(state, sought=len(inliers), age=0)
        elif verdict.accepted and not fit.is_accurate:
            verdict = Verdict(Outcome.AMBIGUOUS, f"{verdict.reason}, hardly better than by chance")
        elif verdict.accepted and count < ENOUGH_LANDMARKS:
            why = f"{verdict.reason}, but the image does not confirm these few tracked ones"
            verdict = Verdict(Outcome.TOO_FEW_MATCHES, why)
        return Measurement(motion, verdict, noise, replace(state, points=inliers))

    def _by_surface(
        self, frame: Frame, image: Grey | None, state: TrackerState, predicted: Motion
    ) -> Measurement | None:
        """Correct a prediction by measured points on the surface, or else by rendered colours; then judge the pose.

        In directions that these measurements do not constrain, such as along a corridor, the prediction is kept.
        """
        surface, view = self.scene.surface, View(frame, SE3.identity())
        reach, covariance = predicted.reach, predicted.covariance
        points = None if surface is None else Surface.of([view], None, surface, state.frames, POINTS)
        if points is None and (image is None or not has_field(self.scene.field)):
            return None
        off = math.sqrt(float((covariance.diagonal() * torch.tensor([1.0] * 3 + [reach**2] * 3)).sum() / 3))
        # Measured points alone may correct a prediction that is uncertain by up to 0.35 of the distance to the scene.
        if image is None and off > 0.35 * reach:
            why = "no colours were recorded, and the prediction is too uncertain for the shape"
            return Measurement(predicted, Verdict(Outcome.UNDETERMINED, why), 1.0, state)
        states = States.known(predicted.T_world_camera, torch.zeros(6, dtype=torch.float64))
        zero, hessian = torch.zeros((1, P), dtype=torch.float64), torch.zeros((1, P, P), dtype=torch.float64)
        hessian[0, :6, :6] = torch.linalg.inv(covariance)
        prediction = Quadratic(states, zero[:, 0], zero, hessian)
        if points is None:
            # In a map without landmarks, 256 rays are rendered for a frame. The start is close, so that few steps suffice.
            rays = RenderedRays.of([view], self.scene.field, self.scene.bounds, 256, state.frames)
            rays = replace(rays, independent=ALONE)
            for _ in range(2):
                states, normal = descend(states, [prediction, rays.fitted(states)], 2)
            share = float(rays.agreement(states))
            measured = Support({"new_inliers": share})
            words = f"{share:.0%} of the rays have the rendered colours"
        else:
            points = replace(points, colour_weight=float(image is not None))
            # At first, the robust loss is three times as wide as suits the residuals. The start is close, so that few steps suffice.
            for wider in (3.0, 1.0):
                fitted = replace(points, noise=max(points.noise, off)).fitted_noise(states)
                # This widens the basin of convergence and keeps the information.
                fitted = replace(fitted, noise=wider * fitted.noise, independent=points.independent * wider**2)
                term = Determined(fitted) if image is None else fitted
                states, normal = descend(states, [prediction, term], 2)
            # A point counts half at a distance of four cells from the surface.
            near, alike = replace(points, noise=2 * points.surface.cell).inliers(states)
            share, colours = float(near.mean()), float((near * alike).mean())
            colour_inliers = None if image is None else colours
            measured = Support({"on_surface": share, "colour_inliers": colour_inliers})
            words = f"{share:.0%} of the measured points lie on the surface"
        information = normal.hessian[0, :6, :6] - hessian[0, :6, :6]
        fused = torch.linalg.inv(normal.hessian[0, :6, :6])
        rest, own = torch.eye(6).double() - fused @ information, fused @ information @ fused
        # Half of the variance of a pose by depth or rendered colours is common to consecutive frames.
        pose = PoseEstimate(
            states.T[0].polished(),
            rest @ predicted.noise[:6, :6] @ rest.T + own / 2,
            rest @ predicted.bias @ rest.T + own / 2,
        )
        moved = update_between(predicted.T_world_camera, pose.T_world_camera)
        motion = predicted.refined(pose)
        deviation = _position_deviation(motion.covariance)
        typical = 0.0 if self.landmarks is None else self.landmarks.trial.translation
        uncertain = f"{words}, but the position is uncertain by {deviation:.3g}"
        verdict = measured.verdict(words)
        doubts = [
            # The pose is within five standard deviations of the prediction (a squared Mahalanobis distance).
            (
                float(moved @ torch.linalg.solve(covariance, moved)) <= 25,
                Outcome.AMBIGUOUS,
                "the measurements fit a place that is inconsistent with the motion",
            ),
            (
                image is not None or state.clock.stamped,
                Outcome.IMPRECISE,
                f"{words}, but without a time stamp the motion is unknown",
            ),
            (deviation <= TOLERANCE * reach, Outcome.IMPRECISE, uncertain),
            # Without colours, the position is bounded in terms of the median error of the map's own images.
            (
                image is not None or not typical or deviation <= 4.5 * typical,
                Outcome.IMPRECISE,
                f"{uncertain}, images by {typical:.3g}",
            ),
        ]
        if verdict.accepted:
            verdict = next((Verdict(outcome, why) for known, outcome, why in doubts if not known), verdict)
        return Measurement(motion, verdict, 1 - share, state)

    def odometry(
        self, frame: Frame, corners: Points, motion: Motion, predicted: Motion, seconds: float
    ) -> tuple[Motion, Points] | None:
        """Return the motion predicted from corners with measured depth, and the corners that agree; None if too few agree."""
        if len(corners) < LEAST_CORNERS:
            return None
        fit = Fit.of(corners, frame.intrinsics, predicted.T_world_camera, CORNERS_PER_INDEPENDENT)
        few = fit.agreeing < max(LEAST_CORNERS, 0.5 * len(corners))
        relative, singular = torch.linalg.inv_ex(fit.term(fit.states).hessian[0, :6, :6])
        if few or fit.log10_nfa > SIGNIFICANT_NFA or bool(singular):
            return None
        relative = (relative + relative.T) / 2
        return motion.moved(fit.states.T[0], relative, seconds), corners[fit.is_inlier]


def search_radius(frame: Frame, predicted: Motion) -> float | None:
    """Return the radius (pixels) within which landmarks very likely project; None if this would cover most of the image."""
    camera = frame.intrinsics
    radius = INLIER * pixel_radius(predicted.covariance, camera.fx, predicted.reach)
    # A radius of more than 0.4 of the diagonal would cover most of the image.
    return radius if radius <= 0.4 * math.hypot(camera.width, camera.height) else None


def shows_shape(frame: Frame) -> bool:
    """Return whether the frame has enough measured depth to recognise the shape of the scene."""
    return frame.depth is not None and int((frame.depth > 0).sum()) >= LEAST_POINTS


def _position_deviation(covariance: Float[Tensor, "6 6"]) -> float:
    """Return the standard deviation (metres) of the position along its least certain direction; infinite if unknown."""
    if not bool(covariance.isfinite().all()):
        return math.inf
    return float(torch.linalg.eigvalsh(covariance[:3, :3])[-1].clamp(min=0).sqrt())
