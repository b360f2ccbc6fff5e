"""The loop: propose a pose, refine it under all explanations, fuse all measurements, and accept the pose or try the next one.

``docs/methods.md#code`` lists which module does which step. A further kind of measurement becomes a term in ``Loop._fused``; it affects the
choice between places only through the log odds in ``Loop._posterior``. Anything else that the image may be, such as a mirror image of the
scene, becomes a mode in ``Loop._other_modes``, and its outcome is chosen in ``Loop._judged``. ``propose`` has the proposals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import run_on
from bidnerf_core.fields import has_field
from bidnerf_core.frames import View
from bidnerf_core.geometry import KEYPOINTS_PER_INDEPENDENT, SE3
from bidnerf_core.localization.accept import Evidence, judge, same_pose
from bidnerf_core.localization.explanations import MOVING, USUAL, Explanations, Proposal, explanations
from bidnerf_core.localization.matching import (
    CELLS,
    STRONGEST,
    LandmarkMatcher,
    Matches,
    Nearest,
    Projected,
    QueryKeypoints,
    cells,
    log10_nfa,
)
from bidnerf_core.localization.posterior import (
    Minima,
    Posterior,
    agreement,
    cost_of,
    fit_modes,
    fit_noise,
    fit_with_rays,
    graduate,
    most_probable,
    refine,
    settle,
    weigh,
)
from bidnerf_core.localization.problem import Problem, extent_of
from bidnerf_core.localization.propose import (
    CONVINCING,
    LEAST_AGREEING,
    best_consensus,
    consensus,
    inliers,
    proposal_at,
    proposals_at,
)
from bidnerf_core.localization.result import Outcome, Verdict, current_record
from bidnerf_core.localization.terms.images import Images, refine_on_small_images
from bidnerf_core.localization.terms.rays import RenderedRays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import CostTerm, Features, LandmarkMap, Landmarks, Sights, States, point_variance, project

MIRROR = "mirror image"
"""Name of the mode of an image whose mirror image fits."""
DEPTH_WIDTH = 2.0
"""Ratio of the prior standard deviation of the depth scale to that of the sensor's model, since some sensors are off by far more."""
RADII = (3.0, 1.5)
"""Radii of the rounds of matching by projection, in units of the inlier threshold."""
HEAVY_TAILS = 1.7
"""Factor on the covariance that makes a Gaussian's 95 % ellipsoid hold 95 % of the poses, since errors have heavier tails."""


@dataclass(frozen=True, eq=False)
class Mode:
    """A place or a mirror image that may explain the query, with the matches that agree with this hypothesis."""

    name: str
    query: QueryKeypoints
    matches: Matches
    by_descriptors: Matches  # found by descriptors alone


@dataclass(frozen=True, eq=False)
class LandmarkAnswer:
    """A landmark-based pose with everything that was fused into it, the explanations of the images, and the verdict."""

    modes: Sequence[Mode]
    posterior: Posterior
    explanations: Explanations
    landmarks: Landmarks
    # Of a right update, translation (metres) first; includes that of the map's own poses.
    covariance: Float[Tensor, "6 6"]
    distance: float  # metres: median distance of the matched landmarks
    evidence: Evidence
    verdict: Verdict
    contradicted: bool  # whether hardly more landmarks match than by chance, although many should
    fused: tuple[str, ...] = ()  # the measurements other than landmarks

    @property
    def T_world_rig(self) -> SE3:
        return self.posterior.pose()

    @property
    def mode(self) -> Mode:
        return self.modes[self.posterior.mode]

    @property
    def is_open(self) -> bool:
        """Whether the verdict depends on measures that rendered rays may change."""
        return all(bound.is_open for bound, _ in self.evidence.violated)

    @property
    def explanation(self) -> str:
        """The name of the most probable explanation."""
        return self.explanations.names[int(self.posterior.states.row[self.posterior.best])]

    @property
    def camera(self) -> Float[Tensor, "6"] | None:
        """The correction of the stated camera, or None if the stated camera is at least approximately right."""
        if self.explanation.removesuffix(MOVING) in USUAL[:3]:
            return None
        return self.posterior.states.nuisances[self.posterior.best, :6]


class Loop:
    """Localizes the images of one problem in a map from landmarks, measured depth and rendered colours."""

    def __init__(
        self,
        views: Sequence[View],
        matcher: LandmarkMatcher,
        problem: Problem | None = None,
        rays: int = 0,
        seed: int = 0,
        features: Features | None = None,
        moving: bool = True,
    ) -> None:
        """Detect keypoints of ``views``, whose poses are relative to the last view.

        Without a ``problem``, only landmarks are used. ``rays`` is the maximum number of rays to render if the map has a field,
        0 for none. ``features`` is the keypoint detector, by default the map's. ``moving`` is true if the camera may have
        moved during the readout.
        """
        self.matcher, self.problem, self.seed, self.moving = matcher, problem, seed, moving
        self.landmarks: LandmarkMap = matcher.landmarks
        self.query = QueryKeypoints.of(views, features or matcher.features)
        noise = None if problem is None else problem.colour_noise
        # The rays of a field with more colour noise on its training images add nothing to the landmarks.
        shows = problem is not None and has_field(problem.field) and (noise is None or noise <= 0.04)
        self.rays = rays if shows else 0
        places = {matcher.device} if problem is None else {matcher.device, problem.device}
        self.device = places.pop() if len(places) == 1 else torch.device("cpu")
        self._nearest: dict[int, Nearest] = {}

    @torch.no_grad()
    def __call__(self) -> LandmarkAnswer | None:
        """Return the best answer; None if no pose agrees with enough landmarks."""
        answer: LandmarkAnswer | None = None
        for proposal, nearest, nfa in self._proposals():
            found = self.answer(proposal, nearest, nfa)
            if found is not None and found.verdict.accepted:
                return found
            if found is not None and (answer is None or found.evidence.log10_nfa < answer.evidence.log10_nfa):
                answer = found
        return answer

    @torch.no_grad()
    def at(self, T_world_rig: SE3) -> LandmarkAnswer | None:
        """Return the answer at a pose found by other means; None if too few landmarks match there."""
        proposal = proposal_at("elsewhere", T_world_rig, self.landmarks)
        return self.answer(proposal, self.nearest(STRONGEST), 0.0, searched=False)

    def answer(self, proposal: Proposal, nearest: Nearest, nfa: float, searched: bool = True) -> LandmarkAnswer | None:
        """Refine a proposal under all explanations, fuse all measurements, and judge the pose; None if too few matches agree."""
        scale = 0.0 if self.problem is None else DEPTH_WIDTH * self.problem.sensor.scale
        given = explanations(self.query, self.landmarks, proposal.distance, scale, self.moving)
        modes, states = self._modes(nearest, proposal, given, nfa, searched)
        if not modes:
            return None
        term = self._term(modes, states)
        states, term = run_on(self.device, weigh, states, term)
        return self._fused(modes, states, term, given, searched)

    def nearest(self, strongest: int) -> Nearest:
        """Return the landmarks most similar to each image's strongest keypoints, of which at most ``strongest`` are used."""
        count = min(strongest, max(len(image.keypoints) for image in self.query.images))
        if count not in self._nearest:
            self._nearest[count] = Nearest.of(self.query, self.matcher, count)
        return self._nearest[count]

    def _proposals(self) -> Iterator[tuple[Proposal, Nearest, float]]:
        """Yield proposals, their matches and log10 false alarms: by consensus on the strongest keypoints, then on all; then at the start."""
        most = max(len(image.keypoints) for image in self.query.images)
        nearest, record = self.nearest(STRONGEST), current_record()
        for count in dict.fromkeys((min(STRONGEST, most), most)):
            nearest = self.nearest(count)
            found = best_consensus(self.query, self.landmarks, nearest.best)
            if found is None:
                continue
            if record is not None:
                record.add(f"sample consensus on {len(nearest.best)} matches", found[0].T)
            yield found[0], nearest, found[1]
            if found[1] < CONVINCING:
                break
        if self.problem is not None and (T := self.problem.start) is not None:
            yield from proposals_at(self.query, self.landmarks, T, extent_of(self.problem), nearest)

    def _term(self, modes: Sequence[Mode], best: States) -> Landmarks:
        """Return the reprojection errors of the modes' matches, padded to equal length; ``best`` (g) are the modes' states.

        On an accelerator, sizes are multiples of 256, so that few CUDA graphs are captured.
        """
        parts, size = [], max(len(mode.matches) for mode in modes)
        size = size if self.device.type == "cpu" else -(-size // 256) * 256
        for number, mode in enumerate(modes):
            count, here = len(mode.matches), best[number : number + 1]
            index = torch.arange(size)
            query, found = mode.query, mode.matches[index.clamp(max=count - 1)]
            focal, sights = query.focal[found.keypoint], query.sights[found.keypoint]
            points = self.landmarks.positions[found.landmark].double()
            variance = point_variance(self.landmarks, found.landmark, here, focal)
            of_sights = sights.image, sights.times, sights.rotation, sights.translation
            parts.append((points, *of_sights, (index < count).double(), variance, focal))
        points, image, times, R, t, valid, variance, focal = (torch.stack(x) for x in zip(*parts, strict=True))
        counts = [self.landmarks.correlation_of(len(mode.matches)) for mode in modes]
        correlation, query = torch.tensor(counts, dtype=torch.float64), modes[0].query
        sights = Sights(image, times, R, t, query.sights.single)
        return Landmarks(
            points, sights, valid, variance, focal, correlation, 1 / correlation, query.area, query.threshold / 2
        )

    def _modes(
        self, nearest: Nearest, proposal: Proposal, given: Explanations, nfa: float, searched: bool
    ) -> tuple[list[Mode], States]:
        """Return the modes and the most probable state of each mode, refined on matches by projection."""
        first = self._mode(proposal.name, self.query, nearest.best, proposal, given, searched)
        if first is None:
            return [], States.known(proposal.T, proposal.camera)
        if searched:
            first = first[0], self._warped(first[0], proposal, given, first[1])
        others = (self._mode(*other, given, True) for other in self._other_modes(nearest, nfa, first[1]))
        both = [first, *(other for other in others if other is not None)]
        modes, best = [mode for mode, _ in both], [state for _, state in both]
        seen: list[Projected | None] = [None] * len(modes)
        for radius in RADII:
            for g, mode in enumerate(modes):
                within = radius * mode.query.threshold
                seen[g] = projected = Projected(mode.query, self.landmarks, best[g], within, seen[g])
                matches = projected.matches(within)
                if len(matches) >= LEAST_AGREEING:
                    modes[g] = mode = replace(mode, matches=matches)
                if radius == RADII[0]:
                    points = self.landmarks.positions[mode.matches.landmark].double()
                    distance = float(best[g].T.inverse().apply(points).norm(dim=-1).median())
                    again = Proposal(mode.name, best[g].T[0], best[g].nuisances[0, :6], distance)
                    best[g] = self._compared(mode, again, given, float(best[g].noise))
                term = self._term([mode], best[g])
                best[g] = run_on(self.device, refine, best[g], term)
        numbered = [replace(state, mode=state.mode + g) for g, state in enumerate(best)]
        return modes, States.cat(numbered)

    def _mode(
        self,
        name: str,
        query: QueryKeypoints,
        found: Matches,
        proposal: Proposal,
        given: Explanations,
        searched: bool,
    ) -> tuple[Mode, States] | None:
        """Return the mode at a proposal and its most probable state; None if too few matches agree.

        If the proposal was ``searched`` for among the matches ``found``, those that agree with it are kept; otherwise, landmarks are
        matched by projection.
        """
        known, within = States.known(proposal.T, proposal.camera), RADII[0] * query.threshold
        if searched:
            near = found[inliers(query, self.landmarks, found, known, RADII[0])]
        else:
            near = Projected(query, self.landmarks, known, within).matches(within)
        if len(near) < LEAST_AGREEING:
            return None
        mode = Mode(name, query, near, found)
        return mode, self._compared(mode, proposal, given, query.threshold / 2)

    def _compared(self, mode: Mode, proposal: Proposal, given: Explanations, noise: float) -> States:
        """Return the most probable state of a mode among the kinds of cameras, each with its own noise, using a subset of the matches."""
        count = len(mode.matches)
        # At most a hundred matches are compared, evenly spread.
        some = torch.linspace(0, count - 1, min(count, 100)).long()
        states = given.first(proposal, 0, noise)
        term = self._term([replace(mode, matches=mode.matches[some])], states[:1])
        term = replace(term, share=term.share * (count / len(some)))
        return run_on(self.device, most_probable, states, term)

    def _warped(self, mode: Mode, proposal: Proposal, given: Explanations, best: States) -> States:
        """Return the fit of a camera that explains any warp of the image if many more matches agree with that fit, else ``best``.

        In a sheared image, or a photo of a picture, consensus finds only the matches that happen to agree with a usual camera. From
        that pose, the fit to all matches is graduated: at first, residuals as large as the warp still count (Blake and Zisserman 1987).
        """
        query, found = mode.query, mode.by_descriptors
        agreeing = int(inliers(query, self.landmarks, found, best).sum())
        if agreeing >= 0.7 * len(found):
            return best
        states = given.first(proposal, 0, query.threshold / 2)
        state = states[(states.row == given.widest).nonzero()[:, 0]]
        term = self._term([replace(mode, matches=found)], best)
        state = run_on(self.device, graduate, state, term)
        more = int(inliers(query, self.landmarks, found, state).sum())
        return state if more > 1.3 * agreeing else best

    def _other_modes(
        self, nearest: Nearest, nfa: float, best: States
    ) -> Iterator[tuple[str, QueryKeypoints, Matches, Proposal]]:
        """Yield the hypotheses that compete with the place of the state ``best``.

        A scene may be repetitive, such as two rooms with the same furniture: keypoints that agree with the state may agree as well with
        similar landmarks elsewhere. The image may also be mirrored. No hypotheses are tried unless a first pose, even a wrong one, agrees
        with at least ``LEAST_AGREEING`` matches of the image as it is.
        """
        query = self.query
        modes: list[tuple[str, QueryKeypoints, Matches]] = []
        q, k = nearest.landmark.shape
        own = nearest.keypoint.repeat_interleave(k)
        points = self.landmarks.positions[nearest.landmark.flatten()].double()[None]
        seen = project(best, points, query.sights[own])
        off = ((seen.image[0] - query.sights.image[own]) * query.focal[own, None]).norm(dim=-1)
        near = ((off <= RADII[0] * query.threshold) & seen.front[0]).view(q, k)
        agreeing = torch.zeros(len(query.view), dtype=torch.bool)
        agreeing[nearest.keypoint] = near[:, 0]
        others = nearest.others(near)
        others = others[agreeing[others.keypoint]]
        # Another place has at least three tenths as many inliers as the first.
        if len(others.keypoint.unique()) >= max(LEAST_AGREEING, 0.3 * int(agreeing.sum())):
            modes.append(("another place", query, others))
        # A pose with fewer than 1e-150 false alarms is unmistakable, so no mirror image is tried.
        if nfa > -150.0 and self.landmarks.features == "sift" and len(query.images) == 1:
            mirrored = query.mirrored
            modes.append((MIRROR, mirrored, Nearest.of(mirrored, self.matcher, STRONGEST).best))
        for name, there, found in modes:
            other = consensus(there, self.landmarks, found, best.nuisances[0, :6], name)
            if other is not None:
                yield name, there, found, other[0]

    def _fused(
        self, modes: list[Mode], best: States, landmarks: Landmarks, given: Explanations, searched: bool
    ) -> LandmarkAnswer:
        """Fuse all measurements under all explanations, and judge the result; rays are rendered only where they can change it."""
        problem, terms = self.problem, list[CostTerm]([landmarks])
        # Up to three fits, until the explanation that a mode is linearized about is its most probable one.
        for _ in range(3):
            row = best.row
            there, minima, best = run_on(self.device, settle, best, landmarks, given)
            if torch.equal(best.row, row):
                best = there
                break
        found = self._posterior(minima, landmarks)
        points, fused = None, list[str]()
        others: dict[str, float | None] = {}
        if problem is not None and problem.surface is not None and problem.has_depth:
            where = "cpu" if problem.surface.device == self.device else None  # ``run_on`` moves them
            points = Surface.of(problem.views, problem.depth_rays, problem.surface, self.seed, device=where)
        if points is not None:
            noise, near, _ = run_on(self.device, fit_noise, points, found.chosen)
            independent = points.independent / self.landmarks.trial.points
            # If less than a tenth of the points lies on the surface, depth is in another unit or of another scene, and is left
            # out. No pose on record with fewer was right, nor would any have been accepted without depth.
            points = replace(points, noise=noise, independent=independent) if float(near) >= 0.1 else None
        if points is not None:
            terms.append(points)
            fused.append("depth")
            best, minima = run_on(self.device, fit_modes, best, terms, given, 5)
            found = self._posterior(minima, landmarks, -run_on(self.device, cost_of, points, best))
            near, both = run_on(self.device, agreement, points, found.chosen)
            others |= {"on_surface": float(near), "colour_inliers": float(both)}
        answer = self._judged(found, modes, landmarks, given, searched, others)
        # The uncertainty of the projection of the scene, in pixels; rays are worth rendering above 0.6.
        blur = float(landmarks.focal.max()) * answer.evidence.precision / math.sqrt(HEAVY_TAILS)
        # Also rendered: places and mirror images that are not much less probable; a mirror image at low resolution alone.
        odds = [float(found.probability[found.states.mode == g].sum()) for g in range(len(modes))]
        places = [g for g in sorted(range(len(modes)), key=lambda g: -odds[g]) if odds[g] > 1e-3]
        which = torch.tensor([g for g in places if modes[g].name != MIRROR])
        if problem is not None and self.rays and blur > 0.6 and answer.is_open and len(which):
            where = "cpu" if problem.device == self.device else None
            rays = RenderedRays.of(
                problem.views, problem.field, problem.bounds, self.rays, self.seed, device=where, steep=True
            )
            # The descent begins at the camera with which some rays agree best, of the most probable ones.
            likely = found.probability.argsort(descending=True)[:8]
            some = minima[1][likely]
            few = rays.first(256)
            loss = few.loss_at(some)
            score = found.probability[likely].log() - Images.INDEPENDENT * loss
            for g in which:
                first = torch.where(some.mode == g, score, -torch.inf).argmax()[None]
                here = some[first]
                # The pose of a camera at rest that may be as stated is first refined where rays would be too fine.
                if bool(given.usual[here.row]) and not given.names[int(here.row)].endswith(MOVING):
                    coarse = refine_on_small_images(problem, here, blur)
                    here = coarse if float(few.loss_at(coarse)) < float(loss[first]) else here
                best = best.with_rows(g[None], here)
            for _ in range(3):  # as above
                row = best.row
                minima, best, weights, by_rays, loss = run_on(
                    self.device, fit_with_rays, best, terms, rays, given, which
                )
                if torch.equal(best.row[which], row[which]):
                    break
            for g in set(places) - set(which.tolist()):
                loss[g] = replace(rays, sights=rays.sights.mirrored).loss_at(best[g : g + 1])[0]
            # A place that was not rendered counts as if the map showed it as well as any other.
            log_odds = -Images.INDEPENDENT * loss.nan_to_num(float(loss.nan_to_num(torch.inf).amin()))
            # Neighbouring rays share the field's errors, which the scatter of the rays' gradients does not show; it shows even
            # less of the errors of rays that agree less than usual, and of a camera that rays determine together with the pose.
            trial, states = self.landmarks.trial, minima[1]
            difference = loss / trial.difference if trial.difference > 0 else torch.full_like(loss, torch.nan)
            factor = trial.rays * difference.nan_to_num(1.0).clamp(min=1.0).square()[states.mode]
            factor = torch.where(given.usual[states.row], factor, KEYPOINTS_PER_INDEPENDENT * factor)
            systematic = (factor - 1)[:, None, None] * by_rays[states.mode]
            found = self._posterior(minima, landmarks, log_odds, systematic, weights)
            if trial.difference > 0:
                others["difference"] = float(difference[found.mode])
            answer = self._judged(found, modes, landmarks, given, searched, others)
            fused.append("rendering")
        return replace(answer, fused=tuple(fused))

    def _posterior(
        self,
        minima: Minima,
        landmarks: Landmarks,
        log_odds: Float[Tensor, "g"] | float = 0.0,
        systematic: Tensor | float = 0.0,
        weights: Float[Tensor, "h"] | None = None,
    ) -> Posterior:
        """Return the posterior over the explanations; ``log_odds`` between the modes come from measurements other than landmarks."""
        quadratic, states, normal = minima
        if self.problem is not None and (start := self.problem.start) is not None:
            # Of two places that look the same, the one nearer to the start is likelier.
            update = (start.inverse() @ quadratic.here.T).log()
            reach = proposal_at("start", start, self.landmarks).distance
            away = update[:, :3].norm(dim=-1) + reach * update[:, 3:].norm(dim=-1)
            # In six dimensions, the density of a normal distribution of unknown width falls with the sixth power of the distance.
            log_odds = log_odds - 6.0 * away.clamp(min=1e-9).log()
        scatter = self.landmarks.calibration_scatter.double()
        return Posterior.of(states, normal, quadratic, landmarks, scatter, systematic, log_odds, weights, self.device)

    def _judged(
        self,
        found: Posterior,
        modes: list[Mode],
        term: Landmarks,
        given: Explanations,
        searched: bool,
        others: dict[str, float | None],
    ) -> LandmarkAnswer:
        """Judge the most probable pose; ``others`` is the evidence from measurements other than landmarks."""
        mode, state = modes[found.mode], found.chosen
        query = mode.query
        inlier = (term.residuals(state)[0][0] <= 9) & (term.valid[found.mode] > 0)
        count, distance = int(inlier.sum()), term.distance(state)
        within = RADII[-1] * query.threshold
        seen = Projected(query, self.landmarks, state, within)
        chance = sum(len(seen.matches(within, shift * within)) for shift in (4, -4)) / 2
        pixels = query.keypoints.pixels[mode.matches.keypoint]
        occupied = cells(pixels, query.camera) + CELLS**2 * query.view[mode.matches.keypoint]
        covariance = HEAVY_TAILS * (found.mixture() + self.landmarks.pose_covariance)
        position = float(covariance[:3, :3].trace().sqrt().nan_to_num(math.inf, math.inf))
        row = found.states.row
        # Modes that were refined to the same pose are one place; a mirror image is another one even there.
        middle = torch.tensor([0.0, 0.0, distance], dtype=torch.float64)
        places = SE3.stack([found.place(g) for g in range(len(modes))])
        same = same_pose(state.T[0], places, middle) & torch.tensor([mode.name != MIRROR for mode in modes])
        same = (found.states.mode == found.mode) | same[found.states.mode]
        agreeing = int(inliers(query, self.landmarks, mode.by_descriptors, state).sum())
        evidence = Evidence(
            log10_nfa=log10_nfa(len(mode.by_descriptors), agreeing, query.by_chance) if searched else 0.0,
            inliers=count,
            by_chance=chance,
            recall=count / max(1, min(seen.visible, len(query.view))),
            spread=len(occupied.unique()) / CELLS**2 / len(query.images),
            noise_ratio=float(state.noise) / self.landmarks.noise,
            other_place=float(found.probability[~same].sum()),
            credible=float(found.probability[given.credible[row]].sum()),
            replaced=float(found.probability[~given.usual[row]].sum()),
            precision=min(position / distance, 1.0),
            mass=found.mass(distance, self.landmarks.pose_covariance, given.credible[row]),
            searched=searched,
            **others,
        )
        verdict = judge(evidence)
        if mode.name == MIRROR and verdict.outcome is not Outcome.TOO_FEW_MATCHES:
            verdict = Verdict(Outcome.MIRRORED, f"the mirror image has {count} landmark inliers", verdict.confidence)
        # Many landmarks are visible, and hardly more match than by chance.
        contradicted = seen.visible >= 200 and count < 1.5 * chance + LEAST_AGREEING
        if (record := current_record()) is not None:
            record.add(f"refined on {count} landmarks", found.pose())
        return LandmarkAnswer(modes, found, given, term, covariance, distance, evidence, verdict, contradicted)
