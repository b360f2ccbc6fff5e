"""The loop: propose a pose, refine it under all explanations, fuse all measurements, and accept the pose or try the next one.

``docs/methods.md#code`` lists which module does which step. A further kind of measurement becomes a term in ``Loop._fuse``; it affects the
choice between places only through the ``log_odds`` there. Anything else that the image may be, such as a mirror image of the scene, becomes
a mode in ``modes``, with a bound in ``accept``. ``propose`` has the proposals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf_core.devices import run_on
from bidnerf_core.errors import enumeration
from bidnerf_core.fields import has_field
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.accept import Evidence, judge, keeps_bound, same_pose
from bidnerf_core.localization.explanations import CAMERAS, USUAL, Explanations, Proposal, explanations
from bidnerf_core.localization.matching import (
    CELLS,
    STRONGEST,
    LandmarkMatcher,
    Nearest,
    Projected,
    QueryKeypoints,
    cells,
    log10_nfa,
)
from bidnerf_core.localization.modes import RADII, Mode, ModeSearch, term_of
from bidnerf_core.localization.posterior import (
    ModeFits,
    Posterior,
    agreement,
    cost_of,
    fit_landmarks,
    fit_modes,
    fit_noise,
    fit_with_rays,
    refine_with_rays,
    weigh,
)
from bidnerf_core.localization.problem import Problem, extent_of
from bidnerf_core.localization.propose import (
    CONVINCING,
    LEAST_AGREEING,
    best_consensus,
    inliers,
    proposal_at,
    proposals_at,
)
from bidnerf_core.localization.result import Localization, Verdict, current_record
from bidnerf_core.localization.terms.images import Images, refine_on_small_images
from bidnerf_core.localization.terms.rays import OUTLIER, RenderedRays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import (
    CostTerm,
    Features,
    HeldOutTrial,
    LandmarkMap,
    Landmarks,
    States,
    true_intrinsics,
)

DEPTH_WIDTH = 2.0
"""Ratio of the prior standard deviation of the depth scale to that of the sensor's model, since some sensors are off by far more."""


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
    fused: tuple[str, ...]  # the measurements other than landmarks

    @property
    def T_world_rig(self) -> SE3:
        return self.posterior.pose()

    @property
    def mode(self) -> Mode:
        return self.modes[self.posterior.mode]

    @property
    def explanation(self) -> tuple[str, bool]:
        """The camera of the most probable explanation (a key of ``CAMERAS``), and whether it moved during the readout."""
        row = int(self.posterior.chosen.row)
        return self.explanations.cameras[row], bool(self.explanations.moves[row])

    @property
    def camera(self) -> Float[Tensor, "6"] | None:
        """The correction of the stated camera, or None if the stated camera is at least approximately right."""
        return None if self.explanation[0] in USUAL[:3] else self.posterior.chosen.nuisances[0, :6]

    def localization(self, problem: Problem, began: float) -> Localization:
        """Return the pose with its verdict, and put this answer on the active record; ``began`` is as for ``Localization.of``."""
        T, noise = self.T_world_rig, float(self.posterior.states.noise[self.posterior.best])
        stated, camera = problem.views[-1].frame.intrinsics, self.camera
        corrected = None if camera is None else true_intrinsics(stated, camera[:6])
        reason = self.verdict.reason
        if self.fused:
            reason += f", fused with {enumeration(self.fused)}"
        if corrected is not None:
            reason += f", with {CAMERAS[self.explanation[0]]}"
            # A focal length from EXIF, or an assumed one, was not stated to be exact.
            reason += "" if problem.focal_is_approximate else " instead of the stated one"
        if self.explanation[1]:
            reason += ", with the motion of a rolling shutter"
        if (record := current_record()) is not None:
            record.answers.append(self)
        path = [T, T] if problem.start is None else [problem.start, T, T]
        losses = torch.full((len(path) - 1,), noise, dtype=torch.float64)
        verdict = replace(self.verdict, reason=reason)
        found = Localization.of(verdict, SE3.stack(path), losses, "auto", began, noise, self.covariance, self.evidence)
        factor = 1.0 if camera is None else float(camera[0].exp())
        return replace(found, intrinsics=corrected, focal_factor=factor)


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
        # The rays of a field with more colour noise on its training images add nothing to the landmarks.
        shows = problem is not None and has_field(problem.field) and (problem.colour_noise or 0.0) <= 0.04
        self.rays = rays if shows else 0
        places = {matcher.device} if problem is None else {matcher.device, problem.device}
        self.device = places.pop() if len(places) == 1 else torch.device("cpu")
        self._nearest: dict[int, Nearest] = {}

    @torch.no_grad()
    def __call__(self) -> LandmarkAnswer | None:
        """Return the best answer; None if no pose agrees with enough landmarks."""
        best: LandmarkAnswer | None = None
        for proposal, nearest, nfa in self._proposals():
            answer = self.answer(proposal, nearest, nfa)
            if answer is not None and answer.verdict.accepted:
                return answer
            if answer is not None and (best is None or answer.evidence.log10_nfa < best.evidence.log10_nfa):
                best = answer
        return best

    @torch.no_grad()
    def at(self, T_world_rig: SE3) -> LandmarkAnswer | None:
        """Return the answer at a pose found by other means; None if too few landmarks match there."""
        proposal = proposal_at("elsewhere", T_world_rig, self.landmarks)
        return self.answer(proposal, self.nearest(STRONGEST), 0.0, searched=False)

    def answer(self, proposal: Proposal, nearest: Nearest, nfa: float, searched: bool = True) -> LandmarkAnswer | None:
        """Refine a proposal under all explanations, fuse all measurements, and judge the pose; None if too few matches agree."""
        scale = 0.0 if self.problem is None else DEPTH_WIDTH * self.problem.sensor.scale
        given = explanations(self.query, self.landmarks, proposal.distance, scale, self.moving)
        first, answer = nearest.best, None
        for _ in range(2):
            search = ModeSearch(self.query, self.matcher, given, self.device)
            modes, states = search(nearest, first, proposal, nfa, searched)
            if not modes:
                break
            states, term = run_on(self.device, weigh, states, term_of(modes, states, self.landmarks, self.device))
            answer = self._fuse(modes, states, term, given, searched)
            # If another place is the most probable one, the places that look like it compete with it, not those that look like the first.
            is_only_place = keeps_bound("other_place", answer.evidence.other_place)
            if answer.posterior.mode == 0 or answer.mode.mirrored or not is_only_place:
                break
            chosen, first, nfa = answer.posterior.chosen, answer.mode.by_descriptors, answer.evidence.log10_nfa
            proposal = Proposal(answer.mode.name, chosen.T[0], chosen.nuisances[0, :6], answer.distance)
        return answer

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
            best = best_consensus(self.query, self.landmarks, nearest.best)
            if best is None:
                continue
            if record is not None:
                record.add(f"sample consensus on {len(nearest.best)} matches", best[0].T)
            yield best[0], nearest, best[1]
            if best[1] < CONVINCING:
                break
        if self.problem is not None and (T := self.problem.start) is not None:
            yield from proposals_at(self.query, self.landmarks, T, extent_of(self.problem), nearest)

    def _fuse(
        self, modes: list[Mode], best: States, landmarks: Landmarks, given: Explanations, searched: bool
    ) -> LandmarkAnswer:
        """Fuse all measurements under all explanations, and judge the result; rays are rendered only where they can change it."""
        terms, fused, others = list[CostTerm]([landmarks]), list[str](), dict[str, float | None]()
        fit = self._settle(fit_landmarks, best, torch.arange(len(best)), landmarks, given)
        found = self._posterior(fit, landmarks, given)
        points = self._points(found.chosen)
        if points is not None:
            terms.append(points)
            fused.append("depth")
            fit = run_on(self.device, fit_modes, fit.likeliest, terms, given, 5)
            found = self._posterior(fit, landmarks, given, -run_on(self.device, cost_of, points, fit.about))
            near, both = run_on(self.device, agreement, points, found.chosen)
            others |= {"on_surface": float(near), "colour_inliers": float(both)}
        answer = self._judge(found, modes, landmarks, given, searched, others, tuple(fused))
        # The uncertainty of the projection of the scene, in pixels; rays are worth rendering above 0.6.
        blur = float(landmarks.focal.max()) * answer.evidence.precision / math.sqrt(HeldOutTrial.tails)
        # Also rendered: places and mirror images that are not much less probable; a mirror image at low resolution alone.
        odds = found.by_mode
        places = [g for g in odds.argsort(descending=True).tolist() if odds[g] > 1e-3]
        which = torch.tensor([g for g in places if not modes[g].mirrored])
        if self.problem is None or not self.rays or blur <= 0.6 or not answer.evidence.is_open or not len(which):
            return answer
        where = "cpu" if self.problem.device == self.device else None
        views, field, bounds = self.problem.views, self.problem.field, self.problem.bounds
        rays = RenderedRays.of(views, field, bounds, self.rays, self.seed, device=where, steep=True)
        fit = self._fit_rays(found, fit, terms, rays, given, which, blur)
        loss = fit.loss
        for g in set(places) - set(which.tolist()):
            loss[g] = replace(rays, sights=rays.sights.mirrored).loss_at(fit.likeliest[g : g + 1])[0]
        # Neighbouring rays share the field's errors, which the scatter of the rays' gradients does not show; it shows even
        # less of the errors of rays that agree less than usual, and of a camera that rays determine together with the pose.
        # The power and the factor were chosen on answers of objects; on record (``answers_halves``), 511 of 586 accepted poses lie inside
        # the 95 % bound of their covariance.
        trial, states = self.landmarks.trial, fit.states
        difference = loss / trial.difference if trial.difference > 0 else torch.full_like(loss, torch.nan)
        factor = trial.rays * difference.nan_to_num(1.0).clamp(min=1.0).pow(6)[states.mode]
        factor = torch.where(given.usual[states.row], factor, 30.0 * factor)
        # A place that was not rendered counts as if the map showed it as well as any other.
        log_odds = -Images.INDEPENDENT * loss.nan_to_num(float(loss.nan_to_num(torch.inf).amin()))
        systematic = (factor - 1)[:, None, None] * fit.by_rays[states.mode]
        found = self._posterior(fit, landmarks, given, log_odds, systematic)
        if trial.difference > 0:
            others["difference"] = float(difference[found.mode])
        return self._judge(found, modes, landmarks, given, searched, others, (*fused, "rendering"))

    def _points(self, state: States) -> Surface | None:
        """Return the term of the measured points with their noise at a state; None if there are too few, or hardly any lies on the surface."""
        problem = self.problem
        if problem is None or problem.surface is None or not problem.has_depth:
            return None
        where = "cpu" if problem.surface.device == self.device else None  # ``run_on`` moves them
        points = Surface.of(problem.views, problem.depth_rays, problem.surface, self.seed, device=where)
        if points is None:
            return None
        noise, near, _ = run_on(self.device, fit_noise, points, state)
        # If less than a tenth of the points lies on the surface, depth is in another unit or of another scene, and is left
        # out. No pose on record with fewer was right, nor would any have been accepted without depth.
        if float(near) < 0.1:
            return None
        return replace(points, noise=noise, independent=points.independent / self.landmarks.trial.points)

    def _fit_rays(
        self,
        found: Posterior,
        fit: ModeFits,
        terms: list[CostTerm],
        rays: RenderedRays,
        given: Explanations,
        which: Int[Tensor, "r"],
        blur: float,
    ) -> ModeFits:
        """Fit rays as well, for the modes ``which``; ``fit`` and its posterior ``found`` are without them.

        The descent begins at the camera with which some rays agree best, of the most probable ones. The pose of a camera at rest that may
        be as stated is first refined on small images where rays would be too fine (``blur`` is in pixels). Several places are compared on few
        rays first, which suffice where the field shows them alike. Where the rays agree clearly less than usual, the descent begins again
        at each distinct camera.
        """
        assert self.problem is not None
        likely = found.probability.argsort(descending=True)[:8]
        some, few, best = fit.states[likely], rays.first(256), fit.likeliest
        loss = few.loss_at(some)
        score = found.probability[likely].log() - Images.INDEPENDENT * loss
        for g in which:
            first = torch.where(some.mode == g, score, -torch.inf).argmax()[None]
            here = some[first]
            if bool((given.usual & ~given.moves)[here.row]):
                coarse = refine_on_small_images(self.problem, here, blur)
                here = coarse if float(few.loss_at(coarse)) < float(loss[first]) else here
            best = best.with_rows(g[None], here)
        for term in (few, rays)[len(which) == 1 :]:
            with_rays = self._settle(fit_with_rays, best, which, terms, term, given, which)
            share = (found.by_mode[which].log() - Images.INDEPENDENT * with_rays.loss[which]).softmax(0).amax()
            if not keeps_bound("other_place", 1 - float(share)):
                return with_rays
        # On record, three of four right poses have rays that agree better.
        agrees = with_rays.loss <= 1.3 * self.landmarks.trial.difference
        if self.landmarks.trial.difference == 0 or bool(agrees[which].all()):
            return with_rays
        worse, best = which[~agrees[which]], with_rays.likeliest
        for g in worse:
            cameras = fit.states[(fit.states.mode == g) & (given.distinct & ~given.moves)[fit.states.row]]
            starts = States.cat([best[g[None]], cameras])
            best = best.with_rows(g[None], run_on(self.device, refine_with_rays, starts, terms, few))
        again = self._settle(fit_with_rays, best, which, terms, rays, given, which)
        return again if float(again.loss[worse].amin()) < float(with_rays.loss[worse].amin()) else with_rays

    def _settle(self, fit: Callable[..., ModeFits], best: States, which: Int[Tensor, "r"], *values: Any) -> ModeFits:
        """Return up to three fits, until the explanations that the modes ``which`` are linearized about are the most probable ones."""
        for _ in range(3):
            found = run_on(self.device, fit, best, *values)
            row, best = best.row, found.likeliest
            if torch.equal(best.row[which], row[which]):
                break
        return found

    def _posterior(
        self,
        fit: ModeFits,
        landmarks: Landmarks,
        given: Explanations,
        log_odds: Float[Tensor, "g"] | float = 0.0,
        systematic: Float[Tensor, "h P P"] | float = 0.0,
    ) -> Posterior:
        """Return the posterior over the explanations; of two places that look the same, the one nearer to the start is likelier.

        ``log_odds`` and ``systematic`` are as for ``Posterior.of``.
        """
        if self.problem is not None and (start := self.problem.start) is not None:
            update = (start.inverse() @ fit.quadratic.here.T).log()
            reach = proposal_at("start", start, self.landmarks).distance
            away = update[:, :3].norm(dim=-1) + reach * update[:, 3:].norm(dim=-1)
            # In six dimensions, the density of a normal distribution of unknown width falls with the sixth power of the distance.
            log_odds = log_odds - 6.0 * away.clamp(min=1e-9).log()
        return Posterior.of(fit, landmarks, given.scatter, self.device, log_odds, systematic)

    def _judge(
        self,
        found: Posterior,
        modes: list[Mode],
        term: Landmarks,
        given: Explanations,
        searched: bool,
        others: dict[str, float | None],
        fused: tuple[str, ...],
    ) -> LandmarkAnswer:
        """Judge the most probable pose; ``others`` is the evidence from the measurements ``fused`` with the landmarks."""
        mode, state = modes[found.mode], found.chosen
        query = mode.query
        inlier = (term.residuals(state)[0][0] <= OUTLIER**2) & (term.valid[found.mode] > 0)
        count, distance = int(inlier.sum()), term.distance(state)
        within = RADII[-1] * query.threshold
        seen = Projected(query, self.landmarks, state, within, mode.seen)
        chance = sum(len(seen.matches(within, shift * within)) for shift in (4, -4)) / 2
        pixels = query.keypoints.pixels[mode.matches.keypoint]
        occupied = cells(pixels, query.camera) + CELLS**2 * query.view[mode.matches.keypoint]
        errors = found.mixture() + self.landmarks.pose_covariance
        # Whether a pose is accepted does not depend on what few images of a map showed of the tails of its errors.
        position = float((HeldOutTrial.tails * errors[:3, :3].trace()).sqrt().nan_to_num(math.inf, math.inf))
        covariance = self.landmarks.trial.tails * errors
        row = found.states.row
        # Modes that were refined to the same pose are one place; a mirror image is another one even there.
        middle = torch.tensor([0.0, 0.0, distance], dtype=torch.float64)
        places = SE3.stack([found.place(g) for g in range(len(modes))])
        same = same_pose(state.T[0], places, middle) & ~torch.tensor([mode.mirrored for mode in modes])
        # Two photos in one image are two places that different keypoints show: the first one, and one beside it.
        views = [m for m, near in zip(modes, same.tolist(), strict=True) if not near]
        views = [m for m in views if (m is modes[0] if mode.beside else m.beside)]
        other_view = max((m.count_unshared(mode.matches) for m in views), default=None)
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
            mirrored=mode.mirrored or None,
            other_view=other_view,
            **others,
        )
        # Many landmarks are visible, and hardly more match than by chance.
        contradicted = seen.visible >= 200 and count < 1.5 * chance + LEAST_AGREEING
        if (record := current_record()) is not None:
            record.add(f"refined on {count} landmarks", found.pose())
        verdict = judge(evidence)
        return LandmarkAnswer(modes, found, given, term, covariance, distance, evidence, verdict, contradicted, fused)
