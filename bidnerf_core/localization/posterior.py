"""The posterior over the explanations of one query: probabilities by Laplace's approximation, and the pose as a mixture.

The module also holds the steps of the loop that depend on tensors alone; a GPU replays each of them as one graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.devices import move_to, run_on
from bidnerf_core.geometry import KEYPOINTS_PER_INDEPENDENT, SE3
from bidnerf_core.localization.explanations import Explanations
from bidnerf_core.localization.terms.images import Images
from bidnerf_core.localization.terms.rays import RenderedRays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import (
    CAMERA,
    CostTerm,
    Landmarks,
    N,
    Normal,
    P,
    Quadratic,
    States,
    descend,
    log_evidence,
    prior,
    total,
)

TOLERANCE = 0.03
"""Largest position error of a right pose, relative to the distance of the scene."""


@dataclass(frozen=True, eq=False)
class ModeFits:
    """All terms fitted under each explanation (h) of each mode (g), by quadratic models about the modes' states."""

    about: States  # (g)
    quadratic: Quadratic
    states: States  # (h) at the minima of the models
    normal: Normal
    weights: Float[Tensor, "h"]  # log evidence for each explanation
    # mean loss of the rays of each mode, in squares of their scale, and Hessians of the rays alone, in the units of the models;
    # NaN and 0 where none were rendered
    loss: Float[Tensor, "g"]
    by_rays: Float[Tensor, "g P P"]

    @property
    def likeliest(self) -> States:
        """The most probable state of each mode: as it was fitted, if the models are about the most probable explanations."""
        member = self.states.mode[None] == self.about.mode[:, None]
        best = self.states[torch.where(member, self.weights[None], -torch.inf).argmax(-1)]
        return self.about if torch.equal(best.row, self.about.row) else best


@dataclass(frozen=True, eq=False)
class Posterior:
    """The explanations (h) with their probabilities; poses are right updates of the most probable explanation's pose."""

    states: States
    normal: Normal
    probability: Float[Tensor, "h"]
    covariance: Float[Tensor, "h 6 6"]  # of the pose under each explanation
    update: Float[Tensor, "h 6"]  # from the pose of the most probable explanation
    best: int

    @staticmethod
    def of(
        fit: ModeFits,
        landmarks: Landmarks,
        scatter: Float[Tensor, "N"],
        device: torch.device = torch.device("cpu"),  # noqa: B008
        log_odds: Float[Tensor, "g"] | float = 0.0,
        systematic: Float[Tensor, "h P P"] | float = 0.0,
    ) -> Posterior:
        """Compare explanations within a mode by their weights, and modes by the evidence of ``landmarks`` and their other ``log_odds``.

        ``scatter`` are the standard deviations of the spurious part of the nuisances; ``systematic`` is the scatter of the gradients of
        each state (in the units of the models) beyond that of independent errors. Most of the computation runs on ``device``.
        """
        states, normal, weights = fit.states, fit.normal, fit.weights
        by_mode, information = run_on(device, _information, states, normal, fit.quadratic, landmarks, systematic)
        member = states.mode[None] == torch.arange(len(fit.about))[:, None]
        norm = torch.where(member, weights[None], -torch.inf).logsumexp(-1)
        # The log odds between places do not grow in proportion to the number of matches, since the right place rarely has fewer than
        # two thirds as many as another: a factor of e in the evidence adds ten. Below an evidence of 50, places are not compared, since
        # a few chance matches are no evidence against even fewer.
        log = weights + (log_odds + 10.0 * by_mode.clamp(min=50.0).log() - norm)[states.mode]
        # Finite, so that explanations none of which is determined are equally probable.
        probability = log.nan_to_num(-1e300, neginf=-1e300).softmax(0)
        best = int(probability.argmax())
        states, covariance = _true_nuisances(states, normal, _robust_covariance(*information), scatter)
        anchor = states.T[best]
        return Posterior(states, normal, probability, covariance, (anchor.inverse() @ states.T).log(), best)

    @property
    def mode(self) -> int:
        return int(self.states.mode[self.best])

    @property
    def chosen(self) -> States:
        """The most probable state (1)."""
        return self.states[self.best : self.best + 1]

    @property
    def _own(self) -> Float[Tensor, "h"]:
        """The probabilities of the explanations, given the most probable mode; 0 for those of other modes."""
        own = self.probability * (self.states.mode == self.mode)
        return own / own.sum()

    @property
    def mean(self) -> Float[Tensor, "6"]:
        """The right update (metres, then radians) from the pose of the best explanation to the mean pose of the most probable mode."""
        return (self._own[:, None] * self.update).sum(0)

    def pose(self) -> SE3:
        return self.states.T[self.best].retract(self.mean)

    @property
    def by_mode(self) -> Float[Tensor, "g"]:
        """The probability of each mode."""
        return self.probability.new_zeros(int(self.states.mode.max()) + 1).index_add(
            0, self.states.mode, self.probability
        )

    def place(self, mode: int) -> SE3:
        """Return the most probable pose of a mode."""
        own = torch.where(self.states.mode == mode, self.probability, -1.0)
        return self.states.T[int(own.argmax())]

    def camera_of(self, row: int) -> tuple[Float[Tensor, "6"], Float[Tensor, "6"]]:
        """Return the correction of the stated camera under an explanation of the best mode, and its standard deviations (six each)."""
        index = int(((self.states.mode == self.mode) & (self.states.row == row)).nonzero()[0, 0])
        deviation = self.states.deviation[index, CAMERA]
        variance = torch.linalg.inv_ex(self.normal.hessian[index]).inverse.diagonal()[6:][CAMERA]
        return self.states.nuisances[index, CAMERA], deviation * variance.clamp(min=0).sqrt()

    def mixture(self) -> Float[Tensor, "6 6"]:
        """Return the covariance of the pose (metres, then radians) over all explanations of the most probable mode.

        It is infinite if one of them does not determine the pose.
        """
        off = self.update - self.mean
        spread = self.covariance + off[:, :, None] * off[:, None]
        own = self._own
        return (
            torch.where(own[:, None, None] > 1e-12, own[:, None, None] * spread, 0)
            .sum(0)
            .nan_to_num(torch.inf, torch.inf, torch.inf)
        )

    def mass(self, distance: float, shared: Float[Tensor, "6 6"], credible: Bool[Tensor, "h"]) -> float:
        """Return the probability that the pose is right and its explanation is ``credible``.

        A pose is right within ``TOLERANCE`` of ``distance`` (metres), the distance of the scene, and within 0.05 rad. ``shared`` is a
        covariance added to the covariances of all explanations.
        """
        weight = self.probability * credible
        return mass_within(weight, self.update - self.mean, self.covariance + shared, TOLERANCE * distance)


def mass_within(
    weight: Float[Tensor, "h"], off: Float[Tensor, "h 6"], covariance: Float[Tensor, "h 6 6"], tolerance: float
) -> float:
    """Return the mass of a Gaussian mixture of updates of at most 0.05 rad and at most ``tolerance`` (metres)."""
    sane = covariance.isfinite().all(-1).all(-1)
    factor, info = torch.linalg.cholesky_ex(
        torch.where(sane[:, None, None], covariance, torch.eye(6, dtype=covariance.dtype))
    )
    drawn = off[:, None] + normal_draws() @ factor.mT
    inside = (drawn[..., :3].norm(dim=-1) <= tolerance) & (drawn[..., 3:].norm(dim=-1) <= 0.05)
    return float((weight * inside.double().mean(-1) * (sane & (info == 0))).sum())  # host


@lru_cache(maxsize=1)
def normal_draws() -> Float[Tensor, "d 6"]:
    """Return 256 draws of a standard normal distribution that cover it evenly (Sobol).

    Scaled to each explanation's Gaussian, these draws integrate the probability mass of the pose within a tolerance.
    """
    even = torch.quasirandom.SobolEngine(6, scramble=True, seed=0).draw(256).double()
    return torch.distributions.Normal(0.0, 1.0).icdf(even.clamp(1e-6, 1 - 1e-6))


def _information(
    states: States, normal: Normal, terms: Quadratic, landmarks: Landmarks, systematic: Tensor | float
) -> tuple[Float[Tensor, "g"], tuple[Tensor, ...]]:
    """Return the landmark evidence for each mode, and the arguments of ``_robust_covariance``."""
    unit, scale, g = terms.here.unit, 1 / states.unit, states.mode
    parts = [unit[:, :, None] * part * unit[:, None] for part in landmarks.sandwich(terms.here)]
    parts = [parts[0][g], parts[1][g], parts[2][g] + systematic]
    hessian, curvature, scatter = (scale[:, :, None] * part * scale[:, None] for part in parts)
    rest = normal.hessian - hessian * (landmarks.share * landmarks.correlation)[g][:, None, None]
    unit = (hessian + rest).diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    hessian, curvature, scatter = (
        unit[..., None] * (x + rest) * unit[..., None, :] for x in (hessian, curvature, scatter)
    )
    factor, info = torch.linalg.cholesky_ex(hessian + 1e-12 * torch.eye(P, dtype=hessian.dtype, device=hessian.device))
    half = torch.linalg.solve_triangular(factor, curvature, upper=False)
    curvature = torch.linalg.solve_triangular(factor, half.mT, upper=False)
    return landmarks.evidence(terms.here), (curvature, scatter, factor, unit, info == 0)


def _robust_covariance(
    curvature: Float[Tensor, "h P P"],
    scatter: Float[Tensor, "h P P"],
    factor: Float[Tensor, "h P P"],
    unit: Float[Tensor, "h P"],
    sound: Bool[Tensor, "h"],
) -> Float[Tensor, "h P P"]:
    """Return the covariance of the unknowns, treating landmarks as an M-estimator and all other terms as a Gaussian likelihood.

    In the scaling by ``unit``, the Hessian has the Cholesky ``factor``, and the cost has the curvature ``factor curvature factor^T``. The
    covariance is infinite where ``sound`` is false.
    """
    eye = torch.eye(P, dtype=curvature.dtype, device=curvature.device)
    sound = sound & curvature.isfinite().all(-1).all(-1)
    values, vectors = torch.linalg.eigh(torch.where(sound[:, None, None], curvature, eye))
    # With few matches the curvature may be indefinite; well-behaved residuals keep it near the Hessian. The curvature counts as
    # at least a fifth of the reweighted Hessian.
    basis = torch.linalg.solve_triangular(factor.mT, vectors, upper=True) / values.clamp(min=0.2)[:, None]
    bread = basis @ torch.linalg.solve_triangular(factor.mT, vectors, upper=True).mT
    found = unit[..., None] * (bread @ scatter @ bread.mT) * unit[..., None, :]
    return torch.where(sound[:, None, None], found, torch.inf)


def _true_nuisances(
    states: States, normal: Normal, covariance: Float[Tensor, "h P P"], scatter: Float[Tensor, "N"]
) -> tuple[States, Float[Tensor, "h 6 6"]]:
    """Return the states with the most probable true nuisances, and the covariance of their poses.

    The apparent camera, or motion, is the true one plus a spurious part, due to landmark errors, of standard deviation ``scatter``. The
    pose follows the true one, in which it is linear once the other unknowns are eliminated.
    """
    H = normal.hessian
    apparent, spurious = states.deviation.square().clamp(min=1e-24), scatter.square()  # apparent = prior + spurious
    prior = torch.where(spurious > 0, (apparent - spurious).clamp(min=0), apparent)
    share = prior / apparent
    # Part of what seems spurious may be real: as lenses move with focus and image stabilisers, no photo rules out a standard
    # deviation of 0.005 of a camera's parameters.
    least = spurious / 2 + torch.cat([prior[:, :4].clamp(min=0.005**2), prior[:, 4:]], -1)
    doubt = least * spurious / (least + spurious) / apparent
    follows = -torch.linalg.solve_ex(H[:, :6, :6], H[:, :6, 6:])[0]  # (h 6 N) by the whitened nuisances
    step = (share - 1) * states.z
    eye = torch.eye(6, dtype=H.dtype, device=H.device).expand(len(H), 6, 6)
    linear = torch.cat([eye, follows * (share - 1)[:, None]], -1)
    pose = linear @ covariance @ linear.mT + (follows * doubt[:, None]) @ follows.mT
    moved = states.retract(torch.cat([(follows @ step[..., None])[..., 0], step], -1))
    pose = (pose + pose.mT) / 2
    # Rounding may leave no covariance where the matches determine the pose only just, or not at all.
    determined = torch.linalg.cholesky_ex(pose.nan_to_num(-1.0, -1.0, -1.0))[1] == 0
    return moved, torch.where(determined[:, None, None], pose, torch.inf)


def graduate(states: States, term: Landmarks) -> States:
    """Refine the states in several fits, lowering the noise from 16 times the largest noise of matched keypoints to that noise."""
    for factor in (16.0, 8.0, 4.0, 2.0, 1.0):
        states = replace(states, noise=torch.full_like(states.noise, factor * term.most_noise))
        states, _ = descend(states, [term], 4)
    return states


def weigh(states: States, term: Landmarks) -> tuple[States, Landmarks]:
    """Return the states with their noise, and the term with its number of independent matches, both estimated from the residuals."""
    states = term.with_noise(states)
    return states, term.weighted_for(states)


def fit_modes(best: States, terms: Sequence[CostTerm], given: Explanations, steps: int) -> ModeFits:
    """Refine the state of each mode (g), and minimize the models about these states under each explanation."""
    about, _ = descend(best, terms, steps)
    quadratic = linearize_modes(about, terms, given)
    states, normal = quadratic.minimum(given.about(quadratic.here))
    none = torch.full_like(quadratic.cost, torch.nan), torch.zeros_like(quadratic.hessian)
    return ModeFits(about, quadratic, states, normal, log_evidence(states, normal), *none)


def linearize_modes(best: States, terms: Sequence[CostTerm], given: Explanations) -> Quadratic:
    """Return the quadratic model of the terms, without priors, about the state of each mode."""
    # The prior fixes nothing that any explanation frees.
    free = best.under(given.deviation.new_zeros(N), given.deviation.amax(0))
    return Quadratic.of(total(free, terms) - prior(free), free)


def fit_landmarks(best: States, term: Landmarks, given: Explanations) -> ModeFits:
    """Fit the landmarks with newly estimated noise."""
    return fit_modes(term.with_noise(best), [term], given, 4)


def refine_with_rays(states: States, terms: Sequence[CostTerm], rays: RenderedRays) -> States:
    """Refine states with rays, and return the most probable one; between them, rays count as whole images do."""
    states, _ = descend(states, [*terms, rays.fitted(states)], 8)
    loss = rays.loss_at(states)
    return states[(states.log_prior - total(states, terms).cost - Images.INDEPENDENT * loss).argmax()[None]]


def fit_with_rays(
    best: States, terms: Sequence[CostTerm], rays: RenderedRays, given: Explanations, which: Int[Tensor, "r"]
) -> ModeFits:
    """Fit the terms, and for the modes ``which`` also rays, which are too expensive to be rendered for all explanations."""
    rays = rays.fitted(best[which])
    here, _ = descend(best[which], [*terms, rays], 4)
    about = best.with_rows(which, here)
    plain = linearize_modes(about, terms, given)
    compared = rays.at(plain.here[which])
    by_rays = Quadratic.of(move_to(compared.normal(), best.z.device), plain.here[which])
    quadratic = plain.with_rows_added(which, by_rays)
    states, normal = quadratic.minimum(given.about(quadratic.here))
    # The cost of rays has small local minima, so that few of its differences between cameras are evidence.
    weights = log_evidence(states, normal)
    weights = weights + (1 - 1 / KEYPOINTS_PER_INDEPENDENT) * (quadratic(states).cost - plain(states).cost)
    loss = torch.full_like(quadratic.cost, torch.nan).index_copy(0, which, compared.loss().to(best.z))
    hessian = torch.zeros_like(quadratic.hessian).index_add(0, which, by_rays.hessian)
    return ModeFits(about, quadratic, states, normal, weights, loss, hessian)


def cost_of(points: Surface, states: States) -> Float[Tensor, "h"]:
    """Return the cost of the points, a negative log likelihood, at each state."""
    return points(states).cost


def agreement(points: Surface, state: States) -> tuple[Tensor, Tensor]:
    """Return the fractions of the points that lie on the surface, and that lie on the surface with a matching colour."""
    near, alike = points.inliers(state)
    return near.mean(), (near * alike).mean()


def fit_noise(points: Surface, state: States) -> tuple[Tensor, Tensor, Tensor]:
    """Return the noise (metres) of the points at a state, and the fractions that ``agreement`` returns at that noise."""
    fitted = points.fitted_noise(state)
    return torch.as_tensor(fitted.noise), *agreement(fitted, state)
