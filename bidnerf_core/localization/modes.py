"""Modes: the places, and the mirror image, that may explain a query, each with the matches that agree with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch

from bidnerf_core.devices import run_on
from bidnerf_core.localization.accept import keeps_bound
from bidnerf_core.localization.explanations import Explanations, Proposal
from bidnerf_core.localization.matching import STRONGEST, LandmarkMatcher, Matches, Nearest, Projected, QueryKeypoints
from bidnerf_core.localization.posterior import fit_landmarks, graduate
from bidnerf_core.localization.propose import LEAST_AGREEING, consensus, inliers
from bidnerf_core.mapping import LandmarkMap, Landmarks, Sights, States, point_variance

RADII = (3.0, 1.5)
"""Radii of the rounds of matching by projection, in units of the inlier threshold."""


@dataclass(frozen=True, eq=False)
class Mode:
    """A place or a mirror image that may explain the query, with the matches that agree with this hypothesis."""

    name: str
    query: QueryKeypoints
    by_descriptors: Matches  # found by descriptors alone
    matches: Matches
    mirrored: bool = False  # whether ``query`` is the mirror image
    beside: bool = False  # whether it explains keypoints that do not agree with the first place, as in a collage
    seen: Projected | None = None  # the landmarks in view, once they are known

    def count_unshared(self, others: Matches) -> int:
        """Return the number of matched keypoints that are not matched in ``others``."""
        return int((~torch.isin(self.matches.keypoint, others.keypoint)).sum())


def term_of(modes: Sequence[Mode], best: States, landmarks: LandmarkMap, device: torch.device) -> Landmarks:
    """Return the reprojection errors of the modes' matches, padded to equal length; ``best`` (g) are the modes' states.

    On an accelerator, sizes are multiples of 256, so that few CUDA graphs are captured.
    """
    parts, size = [], max(len(mode.matches) for mode in modes)
    size = size if device.type == "cpu" else -(-size // 256) * 256
    for number, mode in enumerate(modes):
        count = len(mode.matches)
        index = torch.arange(size)
        query, some = mode.query, mode.matches[index.clamp(max=count - 1)]
        focal, sights = query.focal[some.keypoint], query.sights[some.keypoint]
        points = landmarks.positions[some.landmark].double()
        variance = point_variance(landmarks, some.landmark, best[number : number + 1], focal)
        of_sights = sights.image, sights.times, sights.rotation, sights.translation
        parts.append((points, *of_sights, (index < count).double(), variance, focal))
    points, image, times, R, t, valid, variance, focal = (torch.stack(x) for x in zip(*parts, strict=True))
    counts = [landmarks.correlation_of(len(mode.matches)) for mode in modes]
    correlation, query = torch.tensor(counts, dtype=torch.float64), modes[0].query
    sights = Sights(image, times, R, t, query.sights.single)
    return Landmarks(
        points, sights, valid, variance, focal, correlation, 1 / correlation, query.area, query.threshold / 2
    )


@dataclass(frozen=True, eq=False)
class ModeSearch:
    """Finds the modes at a proposal, and refines each under all explanations on matches by projection."""

    query: QueryKeypoints
    matcher: LandmarkMatcher
    given: Explanations
    device: torch.device

    def __call__(
        self, nearest: Nearest, matches: Matches, proposal: Proposal, nfa: float, searched: bool
    ) -> tuple[list[Mode], States]:
        """Return the modes and the most probable state of each mode; no mode if not more matches agree with the proposal than by chance.

        ``nfa`` is log10 of the number of false alarms of the proposal: above 0, as good a pose is expected of any image. If the proposal was ``searched`` for among the ``matches`` by
        descriptors, those that agree with it are used at first; otherwise, landmarks are matched by projection.
        """
        first = self._select_agreeing(Mode(proposal.name, self.query, matches, matches), proposal, searched)
        none, by_chance = States.known(proposal.T, proposal.camera), nfa > 0
        if first is None:
            return [], none
        if searched and not by_chance:
            first = first[0], self._fit_warp(first[0], proposal, first[1])
        others = (
            self._select_agreeing(mode, there, True)
            for mode, there in self._propose_others(nearest, matches, nfa, first[1])
        )
        modes, best = map(list, zip(first, *(other for other in others if other is not None), strict=True))
        if by_chance and len(modes) == 1:
            return [], none
        for radius in RADII:
            for g, mode in enumerate(modes):
                within = radius * mode.query.threshold
                seen = Projected(mode.query, self.matcher.landmarks, best[g], within, mode.seen)
                matches = seen.matches(within)
                if len(matches) < LEAST_AGREEING:
                    matches = mode.matches
                modes[g] = mode = replace(mode, seen=seen, matches=matches)
                best[g] = self._fit(mode, best[g])
        # Matches by chance are no other view of the scene.
        first = modes[0].matches
        some = [g for g, m in enumerate(modes) if not m.beside or m.count_unshared(first) >= 0.3 * len(first)]
        return [modes[g] for g in some], States.cat(
            [replace(best[g], mode=best[g].mode + n) for n, g in enumerate(some)]
        )

    def _select_agreeing(self, mode: Mode, proposal: Proposal, searched: bool) -> tuple[Mode, States] | None:
        """Return a mode with the matches that agree with a proposal, and its most probable state; None if too few agree."""
        known, within = States.known(proposal.T, proposal.camera), RADII[0] * mode.query.threshold
        if searched:
            near = inliers(mode.query, self.matcher.landmarks, mode.by_descriptors, known, RADII[0])
            matches = mode.by_descriptors[near]
        else:
            matches = Projected(mode.query, self.matcher.landmarks, known, within).matches(within)
        if len(matches) < LEAST_AGREEING:
            return None
        mode = replace(mode, matches=matches)
        # With few matches, a model about the free fit is not accurate at the camera that is chosen, so that it is fitted again.
        return mode, self._fit(mode, self._fit(mode, self._free_camera(proposal)))

    def _free_camera(self, proposal: Proposal) -> States:
        """Return the state of a proposal under the explanation that leaves the camera the most freedom."""
        widest = self.given.widest
        state = States.known(proposal.T, proposal.camera).under(self.given.mean[widest], self.given.deviation[widest])
        return replace(state, row=state.row + widest)

    def _fit(self, mode: Mode, state: States) -> States:
        """Return the most probable state of a mode, fitted to its matches from a state of any camera."""
        term = term_of([mode], state, self.matcher.landmarks, self.device)
        return run_on(self.device, fit_landmarks, state, term, self.given).likeliest

    def _fit_warp(self, mode: Mode, proposal: Proposal, best: States) -> States:
        """Return the fit of a camera that explains any warp of the image if many more matches agree with that fit, else ``best``.

        In a sheared image, or a photo of a picture, consensus finds only the matches that happen to agree with a usual camera. From
        that pose, the fit to all matches is graduated: at first, residuals as large as the warp still count (Blake and Zisserman 1987).
        """
        query, found = mode.query, mode.by_descriptors
        agreeing = int(inliers(query, self.matcher.landmarks, found, best).sum())
        if agreeing >= 0.7 * len(found):
            return best
        term = term_of([replace(mode, matches=found)], best, self.matcher.landmarks, self.device)
        state = run_on(self.device, graduate, self._free_camera(proposal), term)
        more = int(inliers(query, self.matcher.landmarks, found, state).sum())
        return state if more > 1.3 * agreeing else best

    def _propose_others(
        self, nearest: Nearest, matches: Matches, nfa: float, best: States
    ) -> Iterator[tuple[Mode, Proposal]]:
        """Yield the hypotheses that compete with the place of the state ``best``.

        A scene may be repetitive, such as two rooms with the same furniture: keypoints that agree with the state may agree as well with
        similar landmarks elsewhere. Keypoints that do not agree with the state may agree with another, if the image is made of two
        photos. The image may also be mirrored. No hypotheses are tried unless a first pose, even a wrong one, agrees with at least
        ``LEAST_AGREEING`` matches of the image as it is.
        """
        query, landmarks, modes = self.query, self.matcher.landmarks, list[Mode]()
        q, k = nearest.landmark.shape
        every = Matches(nearest.keypoint.repeat_interleave(k), nearest.landmark.flatten())
        near = inliers(query, landmarks, every, best, RADII[0]).view(q, k)
        agreeing = torch.zeros(len(query.view), dtype=torch.bool)
        agreeing[nearest.keypoint] = near[:, 0]
        agreeing[matches.keypoint[inliers(query, landmarks, matches, best, RADII[0])]] = True
        others = nearest.others(near)
        others = others[agreeing[others.keypoint]]
        # Another place, or view, has at least three tenths as many inliers as the first.
        if len(others.keypoint.unique()) >= max(LEAST_AGREEING, 0.3 * int(agreeing.sum())):
            modes.append(Mode("another place", query, others, others))
        rest = nearest.best[~agreeing[nearest.best.keypoint]]
        if len(rest) >= max(LEAST_AGREEING, 0.3 * (len(nearest.best) - len(rest))):
            modes.append(Mode("another view", query, rest, rest, beside=True))
        # A pose with fewer than 1e-150 false alarms is unmistakable, so no mirror image is tried.
        if nfa > -150.0 and landmarks.features == "sift" and len(query.images) == 1:
            matches = Nearest.of(query.mirrored, self.matcher, STRONGEST).best
            modes.append(Mode("mirror image", query.mirrored, matches, matches, mirrored=True))
        for mode in modes:
            other = consensus(mode.query, landmarks, mode.by_descriptors, best.nuisances[0, :6], mode.name)
            if other is not None and (keeps_bound("log10_nfa", other[1]) or not (mode.beside or nfa > 0)):
                yield mode, other[0]
