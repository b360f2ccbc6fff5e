"""The loop: propose a pose, fuse all measurements under all hypotheses, weigh the explanations, accept or go on."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.accept import Evidence, accept
from bidnerf_core.localization.descend import Normal, Term, descend
from bidnerf_core.localization.explanations import Explanations, Seed, explanations, rows
from bidnerf_core.localization.matching import STRONGEST, Matches, Nearest, Projected, log10_nfa
from bidnerf_core.localization.posterior import Posterior
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.propose import best_consensus, consensus, inliers
from bidnerf_core.localization.query import Query
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import AutoConfig
from bidnerf_core.localization.states import Sights, States, project
from bidnerf_core.localization.terms.landmarks import Landmarks, point_variance
from bidnerf_core.localization.terms.rays import FIELD_ERRORS, RAYS, Quadratic, Rays
from bidnerf_core.localization.terms.surface import Surface

UNMISTAKABLE = -150.0
"""Log10 of the number of false alarms below which no mirror image is tried."""
LEAST_RIVAL = 0.3
"""Least number of inliers of another place, as a fraction of those of the first."""
RADII = (3.0, 1.5, 1.5)
"""Radii of the rounds of matching by projection, in units of the inlier threshold."""
TOLERANCE, ANGLE = 0.03, 0.05
"""Within which the pose must be: relative to the distance of the scene, and radians."""
SHARPEST = 0.04
"""Colour noise of a field on its training images above which its rays add nothing to the landmarks."""
import os

RAYS_BELOW = float(os.environ.get("RB", "0.6"))
"""Pixels: standard deviation of the scene's projection by landmarks below which rays add nothing."""


@dataclass(frozen=True, eq=False)
class Mode:
    """A place (or a mirror image) that may explain the photo, with the matches that agree with it."""

    name: str
    query: Query
    matches: Matches
    by_descriptors: Matches  # alone
    parent: int  # number of the mode whose matches it shares: its own, if these are different


class Loop:
    """Localizes the images of one problem in a map by landmarks, measured depth and rendered colours."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.matcher = problem.matcher
        self.landmarks = problem.matcher.landmarks
        self.is_sharp = problem.colour_noise is not None and problem.colour_noise <= SHARPEST

    @torch.no_grad()
    def __call__(self) -> tuple:
        query = Query.of(self.problem.views, self.matcher.features)
        answer = None
        for seed, nearest, nfa in self._proposals(query):
            given = explanations(query, self.landmarks, seed.distance)
            modes, states, term = self._modes(query, nearest, seed, given, nfa)
            answer = self._fused(modes, states, term, given)
            if answer[1].accepted:
                break
        return answer

    def _proposals(self, query: Query) -> Iterator[tuple[Seed, Nearest, float]]:
        """Yield poses, cheapest first: by sample consensus on the strongest keypoints, and then on all."""
        most = max(len(image.keypoints) for image in query.images)
        if most < 4:
            return
        for count in dict.fromkeys((min(STRONGEST, most), most)):
            nearest = Nearest.of(query, self.matcher, count)
            found = best_consensus(query, self.landmarks, nearest.best)
            if found is not None:
                yield found[0], nearest, found[1]
                if found[1] < -20:
                    break

    def _term(self, modes: list[Mode], best: States) -> Landmarks:
        """Return the reprojection errors of the modes' matches, padded; ``best`` (g) are the modes' states."""
        m = max(1, *(len(mode.matches) for mode in modes))
        parts = []
        for number, (query, found) in enumerate((mode.query, mode.matches) for mode in modes):
            k = found.keypoint
            variance = point_variance(
                self.landmarks, found.landmark, best[number : number + 1], query.focal[k]
            )
            sights = query.sights[k]
            points = self.landmarks.positions[found.landmark].double()
            parts.append([
                _padded(points, m, (0.0, 0.0, 1.0)), _padded(sights.image, m), _padded(sights.times, m), _padded(sights.rotation, m),
                _padded(sights.translation, m), _padded(torch.ones(len(found), dtype=torch.float64), m), _padded(variance, m, 1.0),
                _padded(query.focal[k], m, 1.0),
            ])  # fmt: skip
        points, *seen, valid, variance, focal = (torch.stack(part) for part in zip(*parts, strict=True))
        correlation = torch.tensor(
            [self.landmarks.correlation_of(len(mode.matches)) for mode in modes], dtype=torch.float64
        )
        return Landmarks(
            points, Sights(*seen), valid, variance, focal, correlation, 1 / correlation, modes[0].query.area
        )

    def _best(self, states: States, normal: Normal, modes: list[Mode]) -> States:
        """Return the most probable state of each mode."""
        log = states.log_prior - normal.cost
        member = states.mode[None] == torch.arange(len(modes))[:, None]
        return states[torch.where(member, log[None], -torch.inf).argmax(-1)]

    def _modes(
        self, query: Query, nearest: Nearest, seed: Seed, given: Explanations, nfa: float
    ) -> tuple[list[Mode], States, Landmarks]:
        """Return the modes, and a state for each of their hypotheses, refined on matches by projection."""
        matches, noise = nearest.best, query.threshold / 2
        modes, states = [Mode("landmarks", query, matches, matches, 0)], rows(seed, given, 0, noise)
        term = self._term(modes, states[:1])
        states, normal = descend(states, [term], 8)
        best = self._best(states, normal, modes)
        for name, there, found in self._rivals(query, nearest, best, nfa):
            other = consensus(there, self.landmarks, found, best.nuisances[0, :6], name)
            if other is None:
                continue
            modes.append(Mode(name, there, found, found, len(modes)))
            states = States.cat([states, rows(other[0], given, len(modes) - 1, noise)])
        if len(modes) > 1:
            best = States.cat([best, *(states[states.mode == g][:1] for g in range(1, len(modes)))])
            term = self._term(modes, best)
            states, normal = descend(states, [term], 8)
            best = self._best(states, normal, modes)
        for radius in RADII:
            modes = [
                replace(mode, matches=self._guided(mode, best[g : g + 1], radius))
                for g, mode in enumerate(modes)
            ]
            term = self._term(modes, best)
            best = term.with_noise(best)
            best, _ = descend(best, [term], 4)
        best = term.with_noise(best)
        term = term.weighted_for(best)
        again = [self._again(best[g : g + 1], term, given) for g in range(len(modes))]
        return modes, States.cat(again), term

    def _again(self, best: States, term: Landmarks, given: Explanations) -> States:
        """Return a state for each hypothesis, from the refined best one of a mode."""
        g = int(best.mode)
        z = best.T.inverse().apply(term.points[g]).norm(dim=-1)
        distance = float(z[term.valid[g] > 0].median())
        return rows(Seed("again", best.T[0], best.nuisances[0, :6], distance), given, g, float(best.noise))

    def _guided(self, mode: Mode, state: States, radius: float) -> Matches:
        within = radius * mode.query.threshold
        found = Projected(mode.query, self.landmarks, state, within).matches(within)
        return found if len(found) >= 6 else mode.matches

    def _rivals(
        self, query: Query, nearest: Nearest, best: States, nfa: float
    ) -> Iterator[tuple[str, Query, Matches]]:
        """Yield matches with similar landmarks at other places, and those of the mirror image."""
        q, k = nearest.landmark.shape
        own = nearest.keypoint.repeat_interleave(k)
        points = self.landmarks.positions[nearest.landmark.flatten()].double()[None]
        seen = project(best, points, query.sights[own])
        off = ((seen.image[0] - query.sights.image[own]) * query.focal[own, None]).norm(dim=-1)
        near = ((off <= 3 * query.threshold) & seen.front[0]).view(q, k)
        agreeing = torch.zeros(len(query.view), dtype=torch.bool)
        agreeing[nearest.keypoint] = near[:, 0]
        others = nearest.others(near)
        others = others[agreeing[others.keypoint]]
        least = max(6, LEAST_RIVAL * int(agreeing.sum()))
        if len(others.keypoint.unique()) >= least:
            yield "other place", query, others
        if nfa > UNMISTAKABLE and self.landmarks.features == "sift" and len(query.images) == 1:
            mirrored = query.mirrored
            yield "mirror image", mirrored, Nearest.of(mirrored, self.matcher, STRONGEST).best

    def _fused(self, modes: list[Mode], states: States, landmarks: Landmarks, given: Explanations) -> tuple:
        """Fuse all measurements under all explanations, and judge the result."""
        states, normal = descend(states, [landmarks], 3)
        states = landmarks.with_noise(states)
        states, normal = descend(states, [landmarks], 5)
        terms: list[Term] = [landmarks]
        first = self._posterior(states, normal, landmarks, modes)
        problem, depth = self.problem, None
        if problem.surface is not None and problem.has_depth:
            depth = Surface.of(problem.views, problem.depth_rays, problem.surface, 0)
        if depth is not None and first.mode == 0:
            depth = depth.fitted_noise(first.states[first.best : first.best + 1])
            terms.append(depth)
            states, normal = descend(states, terms, 5)
            first = self._posterior(states, normal, landmarks, modes)
        before = first  # rays about one camera's pose must not decide between cameras
        if self.is_sharp and first.mode == 0 and self._blur(first, landmarks) > RAYS_BELOW:
            best = states[first.best : first.best + 1]
            rays = Rays.of(problem.views, problem.field, problem.bounds, RAYS, 0).fitted(best)
            best, _ = descend(best, [*terms, rays], 4)
            quadratic = Quadratic.of(rays, best)  # rays are too expensive for all hypotheses
            terms.append(quadratic)
            there = replace(states, T=best.T[torch.zeros(len(states), dtype=torch.long)])
            states, normal = descend(there.where(states.mode == first.mode, states), terms, 5)
            first = self._posterior(
                states, normal, landmarks, modes, (FIELD_ERRORS - 1) * quadratic(states).hessian
            )
        return self._judged(first, before, modes, landmarks, depth, given)

    def _blur(self, found: Posterior, term: Landmarks) -> float:
        """Return the standard deviation of the scene's projection at the best pose, pixels."""
        covariance = found.mixture()
        if not bool(covariance.isfinite().all()):
            return math.inf
        distance = self._distance(found, term)
        return float(modes_focal(term) * covariance[:3, :3].trace().sqrt()) / distance

    def _distance(self, found: Posterior, term: Landmarks) -> float:
        g = found.mode
        z = found.states.T[found.best].inverse().apply(term.points[g]).norm(dim=-1)
        return float(z[term.valid[g] > 0].median())

    def _posterior(
        self, states: States, normal: Normal, landmarks: Landmarks, modes: list[Mode], systematic=0.0
    ) -> Posterior:
        parents = torch.tensor([mode.parent for mode in modes])
        scatter = self.landmarks.calibration_scatter.double()
        return Posterior.of(states, normal, landmarks, parents, scatter, systematic)

    def _judged(
        self,
        found: Posterior,
        before: Posterior,
        modes: list[Mode],
        term: Landmarks,
        depth: Surface | None,
        given: Explanations,
    ) -> tuple:
        mode, state = modes[found.mode], found.states[found.best : found.best + 1]
        squared = term.residuals(state)[0][0]
        inlier = (squared <= 9) & (term.valid[found.mode] > 0)
        count = int(inlier.sum())
        query = mode.query
        distance = self._distance(found, term)
        radius = RADII[-1] * query.threshold
        seen = Projected(query, self.landmarks, state, radius)
        chance = len(seen.matches(radius, 4 * radius))
        pixels = query.keypoints.pixels[mode.matches.keypoint]
        size = torch.tensor([query.camera.width, query.camera.height])
        cells = ((pixels / size * 10).long().clamp(0, 9) * torch.tensor([1, 10])).sum(-1)
        cells = cells + 100 * query.view[mode.matches.keypoint]
        shared = self.landmarks.pose_covariance
        covariance = found.mixture() + shared
        position = covariance[:3, :3].trace().sqrt() if bool(covariance.isfinite().all()) else math.inf
        credible = given.credible[found.states.row]
        agreeing = int(inliers(query, self.landmarks, mode.by_descriptors, state).sum())
        evidence = Evidence(
            log10_nfa=log10_nfa(len(mode.by_descriptors), agreeing, query.by_chance), inliers=count,
            above_chance=(1 + count) / (1 + chance), recall=count / max(1, min(seen.visible, len(query.view))),
            spread=len(cells.unique()) / 100 / len(query.images), noise_ratio=float(state.noise) / self.landmarks.noise,
            mass=min(x.mass(distance, shared, TOLERANCE, ANGLE, credible) for x in (found, before)),
            precision=float(position) / distance, other_mode=float(found.probability[found.states.mode != found.mode].sum()),
            credible=float(found.probability[credible].sum()), surprise=float(state.z.square().sum()),
            on_surface=1.0 if depth is None else float(depth.near(state).mean()),
        )  # fmt: skip
        verdict = accept(evidence)
        if mode.name == "mirror image":
            verdict = Verdict(Outcome.MIRRORED, "the mirror image fits better")
        extra = {"row": given.names[int(state.row)], "rows": {}}
        for p, r, m in zip(found.probability.tolist(), found.states.row.tolist(), found.states.mode.tolist()):
            if p > 0.01:
                extra["rows"][f"{m}:{given.names[r]}"] = round(p, 3)
        extra["nuis"] = [round(x, 4) for x in state.nuisances[0].tolist()]
        extra["blur"] = self._blur(before, term)
        return found.pose(), verdict, covariance, evidence, extra


def modes_focal(term: Landmarks) -> float:
    return float(term.focal.max())


def _padded(values: Tensor, count: int, fill: float | tuple[float, ...] = 0.0) -> Tensor:
    filler = torch.as_tensor(fill, dtype=values.dtype).expand(count - len(values), *values.shape[1:])
    return torch.cat([values, filler])


def localized(problem: Problem, config: AutoConfig, seed: int) -> Localization:
    began = time.perf_counter()
    answer = Loop(problem)() if problem.matcher is not None else None
    if answer is None:
        T, verdict, covariance, evidence, extra = (
            SE3.identity(),
            Verdict(Outcome.TOO_FEW_MATCHES, "no pose agrees with enough landmarks"),
            None,
            None,
            {},
        )
    else:
        T, verdict, covariance, evidence, extra = answer
    found = Localization(
        T, verdict.outcome, verdict.reason, 1, time.perf_counter() - began, 0.0, "auto", SE3.stack([T]),
        torch.zeros(1), covariance, confidence=verdict.confidence, diagnostics=evidence,
    )  # fmt: skip
    object.__setattr__(found, "extra", extra)
    return found
