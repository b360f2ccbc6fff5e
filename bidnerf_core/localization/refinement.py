"""The steps of the loop that depend on tensors alone; a GPU replays each step as one graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from bidnerf_core.localization.explanations import Explanations
from bidnerf_core.localization.terms.rays import Rays
from bidnerf_core.localization.terms.surface import Surface
from bidnerf_core.mapping import (
    Landmarks,
    N,
    Normal,
    Quadratic,
    States,
    Term,
    descend,
    log_evidence,
    prior,
    total,
)


def most_probable(states: States, term: Landmarks) -> States:
    """Refine the states, each with its own noise, and return the most probable one."""
    states, _ = descend(states, [term], 4)
    states, normal = descend(term.with_noise(states), [term], 3)
    return states[log_evidence(states, normal).argmax()[None]]


def graduate(states: States, term: Landmarks) -> States:
    # The noise is decreased to that of usual fits.
    for factor in (16.0, 8.0, 4.0, 2.0, 1.0):
        states = replace(states, noise=torch.full_like(states.noise, factor * term.most_noise))
        states, _ = descend(states, [term], 4)
    return states


def refine(states: States, term: Landmarks) -> States:
    return descend(term.with_noise(states), [term], 3)[0]


def weigh(states: States, term: Landmarks) -> tuple[States, Landmarks]:
    states = term.with_noise(states)
    return states, term.weighted_for(states)


Minima = tuple[Quadratic, States, Normal]
"""The model of all terms about the state of each mode, and its minimum under each explanation of the mode."""


def fit(best: States, terms: Sequence[Term], given: Explanations, steps: int) -> tuple[States, Minima]:
    """Return the refined state of each mode (g), and the minima about these states."""
    best, _ = descend(best, terms, steps)
    quadratic = linearize(best, terms, given)
    return best, (quadratic, *quadratic.minimum(given.about(quadratic.here)))


def linearize(best: States, terms: Sequence[Term], given: Explanations) -> Quadratic:
    # The prior fixes nothing that any explanation frees.
    free = best.under(given.deviation.new_zeros(N), given.deviation.amax(0))
    return Quadratic.of(total(free, terms) - prior(free), free)


def settle(best: States, term: Landmarks, given: Explanations) -> tuple[States, Minima, States]:
    """Return the results of ``fit``, and then the most probable state of each mode."""
    best, (quadratic, states, normal) = fit(term.with_noise(best), [term], given, 4)
    member = states.mode[None] == best.mode[:, None]
    log = torch.where(member, log_evidence(states, normal)[None], -torch.inf)
    return best, (quadratic, states, normal), states[log.argmax(-1)]


def fit_with_rays(
    best: States, terms: Sequence[Term], rays: Rays, given: Explanations
) -> tuple[Minima, Quadratic]:
    """Refine the first state with rays; return the minima, and the quadratic model of the rays about this state alone.

    Rays are too expensive to be rendered for all hypotheses.
    """
    rays = rays.fitted(best)
    here, _ = descend(best[:1], [*terms, rays], 8)
    quadratic = linearize(States.cat([here, best[1:]]), terms, given)
    by_rays = Quadratic.of(rays(quadratic.here[:1]), quadratic.here[:1])
    quadratic = quadratic.with_first(by_rays)
    return (quadratic, *quadratic.minimum(given.about(quadratic.here))), by_rays


def agreement(points: Surface, state: States) -> tuple[Tensor, Tensor]:
    """Return the fractions of the points that lie on the surface, and that lie on the surface with a matching colour."""
    near, alike = points.inliers(state)
    return near.mean(), (near * alike).mean()


def fit_noise(points: Surface, state: States) -> tuple[Tensor, Tensor, Tensor]:
    """Return the noise of the points at a state, and the points' agreement with that state."""
    fitted = points.fitted_noise(state)
    return torch.as_tensor(fitted.noise), *agreement(fitted, state)
