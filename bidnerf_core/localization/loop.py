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
from bidnerf_core.localization.descend import Quadratic, Term, descend, log_evidence, prior, total
from bidnerf_core.localization.explanations import Explanations, Seed, explanations
from bidnerf_core.localization.matching import STRONGEST, Matches, Nearest, Projected, log10_nfa
from bidnerf_core.localization.posterior import Posterior
from bidnerf_core.localization.problem import Problem
from bidnerf_core.localization.propose import LEAST_AGREEING, best_consensus, consensus, inliers
from bidnerf_core.localization.query import Query
from bidnerf_core.localization.result import Localization, Outcome, Verdict
from bidnerf_core.localization.settings import AutoConfig
from bidnerf_core.localization.states import Sights, States, project
from bidnerf_core.localization.terms.landmarks import Landmarks, point_variance
from bidnerf_core.localization.terms.rays import FIELD_ERRORS, RAYS, Rays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import GIVEN, Calibration

UNMISTAKABLE = -150.0
"""Log10 of the number of false alarms below which no mirror image is tried."""
DEPTH_WIDTH = 2.0
"""Ratio of the prior's deviation of the depth scale to that of the sensor's model, since some sensors are off by far more."""
LEAST_RIVAL = 0.3
"""Least number of inliers of another place, as a fraction of those of the first."""
REFITS = 3
"""Most fits of a mode until the explanation that it is linearized about is the most probable one."""
MOST_FIRST = 100
"""Number of matches by descriptors to which the first fits are made."""
RADII = (3.0, 1.5)
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
            given = explanations(
                query, self.landmarks, seed.distance, DEPTH_WIDTH * self.problem.sensor.scale
            )
            modes, states, term = self._modes(query, nearest, seed, given, nfa)
            if not modes:
                continue
            found = self._fused(modes, states, term, given)
            if answer is None or found[1].accepted or found[3].log10_nfa < answer[3].log10_nfa:
                answer = found
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
            points,
            Sights(*seen),
            valid,
            variance,
            focal,
            correlation,
            1 / correlation,
            modes[0].query.area,
            modes[0].query.threshold / 2,
        )

    def _modes(
        self, query: Query, nearest: Nearest, seed: Seed, given: Explanations, nfa: float
    ) -> tuple[list[Mode], States | None, Landmarks | None]:
        """Return the modes, and the most probable state of each, refined on matches by projection."""
        modes: list[Mode] = []
        best: list[States] = []
        for name, there, found, start in self._places(query, nearest, seed, given, nfa, best):
            known = States.known(start.T, start.camera)
            near = found[inliers(there, self.landmarks, found, known, 3)]
            if len(near) < LEAST_AGREEING:
                continue
            mode = Mode(name, there, near, found)
            modes.append(mode)
            best.append(self._compared(mode, start, given, query.threshold / 2))
        if not modes:
            return [], None, None
        seen: list[Projected | None] = [None] * len(modes)
        for radius in RADII:
            for g, mode in enumerate(modes):
                within = radius * mode.query.threshold
                seen[g] = Projected(mode.query, self.landmarks, best[g], within, seen[g])
                found = seen[g].matches(within)
                modes[g] = mode = replace(
                    mode, matches=found if len(found) >= LEAST_AGREEING else mode.matches
                )
                if radius == RADII[0]:
                    z = (
                        best[g]
                        .T.inverse()
                        .apply(self.landmarks.positions[mode.matches.landmark].double())
                        .norm(dim=-1)
                    )
                    again = Seed(mode.name, best[g].T[0], best[g].nuisances[0, :6], float(z.median()))
                    best[g] = self._compared(mode, again, given, float(best[g].noise))
                term = self._term([mode], best[g])
                best[g], _ = descend(term.with_noise(best[g]), [term], 3)
        states = States.cat([replace(state, mode=state.mode + g) for g, state in enumerate(best)])
        term = self._term(modes, states)
        states = term.with_noise(states)
        return modes, states, term.weighted_for(states)

    def _compared(self, mode: Mode, seed: Seed, given: Explanations, noise: float) -> States:
        """Return the most probable state of a mode, comparing kinds of cameras, each with its own noise, on some of the matches."""
        count = len(mode.matches)
        some = torch.linspace(0, count - 1, min(count, MOST_FIRST)).long()
        states = given.first(seed, 0, noise)
        term = self._term([replace(mode, matches=mode.matches[some])], states[:1])
        term = replace(term, share=term.share * (count / len(some)))
        states, _ = descend(states, [term], 4)
        states, normal = descend(term.with_noise(states), [term], 3)
        return replace(
            states[log_evidence(states, normal).argmax()[None]], mode=torch.zeros(1, dtype=torch.long)
        )

    def _places(
        self, query: Query, nearest: Nearest, seed: Seed, given: Explanations, nfa: float, best: list[States]
    ) -> Iterator[tuple[str, Query, Matches, Seed]]:
        """Yield the seed, and others that compete with it; ``best`` has the state refined from each before the next is asked for."""
        matches = nearest.best
        yield "landmarks", query, matches, seed
        if not best:
            return
        for name, there, found in self._rivals(query, nearest, best[0], nfa):
            other = consensus(there, self.landmarks, found, best[0].nuisances[0, :6], name)
            if other is not None:
                yield name, there, found, other[0]

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

    def _settled(self, best: States, term: Landmarks, given: Explanations) -> tuple[States, Quadratic]:
        """Return the most probable state of each mode (g), and the model about it by which it is the most probable."""
        for _ in range(REFITS):
            best, _ = descend(term.with_noise(best), [term], 4)
            free = best.under(*given.prior_of_all)
            quadratic = Quadratic.of(term(free), free)
            states, normal = quadratic.minimum(given.about(free))
            member = states.mode[None] == torch.arange(len(best))[:, None]
            found = states[torch.where(member, log_evidence(states, normal)[None], -torch.inf).argmax(-1)]
            if bool((found.row == best.row).all()):
                break
            best = found
        return best, quadratic

    def _fused(self, modes: list[Mode], best: States, landmarks: Landmarks, given: Explanations) -> tuple:
        """Fuse all measurements under all explanations, and judge the result."""
        best, quadratic = self._settled(best, landmarks, given)
        first = self._posterior(best, quadratic, landmarks, modes, given)
        problem, depth = self.problem, None
        terms: list[Term] = [landmarks]
        if problem.surface is not None and problem.has_depth:
            depth = Surface.of(problem.views, problem.depth_rays, problem.surface, 0)
        if depth is not None and first.mode == 0:
            depth = depth.fitted_noise(first.states[first.best : first.best + 1])
            terms.append(depth)
            best, _ = descend(best, terms, 5)
            free = best.under(*given.prior_of_all)
            quadratic = Quadratic.of(landmarks(free) + depth(free), free)
            first = self._posterior(free, quadratic, landmarks, modes, given)
        before = first  # rays about one camera's pose must not decide between cameras
        if self.is_sharp and first.mode == 0 and self._blur(first, landmarks) > RAYS_BELOW:
            best = first.states[first.best : first.best + 1]
            rays = Rays.of(problem.views, problem.field, problem.bounds, RAYS, 0).fitted(best)
            best, _ = descend(best, [*terms, rays], 4)
            own = best.under(*given.prior_of_all)
            free = own if len(free) == 1 else States.cat([own, free[1:]])
            by_rays = rays(own)
            found = total(free, terms) - prior(free)
            found = replace(
                found,
                cost=_with_first(found.cost, by_rays.cost),
                gradient=_with_first(found.gradient, by_rays.gradient),
                hessian=_with_first(found.hessian, by_rays.hessian),
            )
            quadratic = Quadratic.of(found, free)
            systematic = torch.zeros_like(quadratic.hessian)
            systematic[:1] = (FIELD_ERRORS - 1) * Quadratic.of(by_rays, own).hessian
            first = self._posterior(free, quadratic, landmarks, modes, given, systematic)
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
        self,
        free: States,
        quadratic: Quadratic,
        landmarks: Landmarks,
        modes: list[Mode],
        given: Explanations,
        systematic=0.0,
    ) -> Posterior:
        scatter = self.landmarks.calibration_scatter.double()
        return Posterior.of(given.about(free), quadratic, landmarks, scatter, systematic)

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
        by_stated = not bool(given.mean[int(state.row), :6].any())
        if not by_stated or given.names[int(state.row)].split()[0] not in ("exact", "right", "inexact"):
            taken = state.nuisances if by_stated else given.mean[state.row]
            extra["camera"] = Calibration(*taken[0, :5].tolist())
        extra["blur"] = self._blur(before, term)
        return found.pose(), verdict, covariance, evidence, extra


def modes_focal(term: Landmarks) -> float:
    return float(term.focal.max())


def _with_first(values: Tensor, first: Tensor) -> Tensor:
    return torch.cat([values[:1] + first, values[1:]])


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
    calibration, stated = extra.get("camera", GIVEN), problem.views[-1].frame.intrinsics
    found = Localization(
        T, verdict.outcome, verdict.reason, 1, time.perf_counter() - began, 0.0, "auto", SE3.stack([T]),
        torch.zeros(1), covariance, calibration.focal_factor, verdict.confidence, evidence,
        None if calibration == GIVEN else calibration.applied(stated),
    )  # fmt: skip
    object.__setattr__(found, "extra", extra)
    return found
