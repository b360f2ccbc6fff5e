"""The posterior of a pose: its covariance against repeated trials, probabilities of places and tolerances, and the true camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

from bidnerf import SE3
from bidnerf_core.localization import Posterior

# Inside: explanations, the tolerance, relative to which the distances of the scene are varied, and a fit of terms in closed form
from bidnerf_core.localization.posterior import TOLERANCE, ModeFits
from bidnerf_core.mapping import (
    NUISANCES,
    Landmarks,
    Quadratic,
    Sights,
    States,
    descend,
    log_evidence,
    prior,
    project,
    total,
)

M, FOCAL, NOISE = 150, 300.0, 0.5  # matches; pixels
CAMERA = torch.tensor([0.01, 0.01, 0.01, 0.01, 0.001, 0.0], dtype=torch.float64)
TRUTH = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3], dtype=torch.float64))
NO_SCATTER = torch.zeros(len(NUISANCES), dtype=torch.float64)
NOTHING = torch.zeros((6, 6), dtype=torch.float64)


def deviation(camera: Tensor = CAMERA) -> Tensor:
    return torch.cat([camera, torch.zeros(len(NUISANCES) - 6, dtype=torch.float64)])


def state(wide: Tensor, mode: int = 0, T: SE3 = TRUTH) -> States:
    zero = torch.zeros((1, len(NUISANCES)), dtype=torch.float64)
    number = torch.tensor([mode])
    return States(T[None], zero, zero, wide[None], zero[:, 0], zero[:, 0] + NOISE, number, 0 * number)


def matches(seed: int, outliers: float = 0.0, nuisances: Tensor | None = None, m: int = M) -> Landmarks:
    """Return matches with noise, of which a share are wrong, seen by a camera with these nuisances."""
    generator = Generator().manual_seed(seed)
    flat = torch.rand((m, 2), generator=generator, dtype=torch.float64) - 0.5
    z = 3 + 2 * torch.rand((m, 1), generator=generator, dtype=torch.float64)
    points = TRUTH.apply(torch.cat([1.2 * flat * z, z], -1))[None]
    eye, zero = torch.eye(3, dtype=torch.float64).expand(m, 3, 3), torch.zeros((m, 3), dtype=torch.float64)
    times = flat[:, 1]  # the rows are exposed one after the other
    sights = Sights(zero[:, :2], times, eye, zero)
    true = state(deviation())
    true = true if nuisances is None else replace(true, mean=nuisances[None])
    noise = torch.randn((m, 2), generator=generator, dtype=torch.float64)
    image = project(true, points, sights).image[0] + NOISE / FOCAL * noise
    wrong = torch.rand(m, generator=generator) < outliers
    image[wrong] = 1.2 * (torch.rand((int(wrong.sum()), 2), generator=generator, dtype=torch.float64) - 0.5)
    one = torch.ones((1, m), dtype=torch.float64)
    seen = Sights(image[None], times[None], eye[None], zero[None])
    each = one[:, 0]
    return Landmarks(points, seen, one, 0 * one, FOCAL * one, each, each, 400 * 300.0, 5.0)


def fitted(quadratic: Quadratic, given: States) -> ModeFits:
    """Return the fit of models under some explanations, without rays."""
    states, normal = quadratic.minimum(given)
    none = torch.full_like(quadratic.cost, torch.nan), torch.zeros_like(quadratic.hessian)
    return ModeFits(quadratic.here, quadratic, states, normal, log_evidence(states, normal), *none)


def solved(
    term: Landmarks, wide: Tensor | None = None, scatter: Tensor = NO_SCATTER, explained: States | None = None
) -> Posterior:
    """Return the posterior of an explanation that leaves ``wide`` free, or of several ones of the mode."""
    free = state(deviation() if wide is None else wide)
    start = replace(free, T=free.T.retract(torch.full((1, 6), 0.01, dtype=torch.float64)))
    found, _ = descend(start, [term], 15)
    found = term.with_noise(found)
    term = term.weighted_for(found)
    found, _ = descend(found, [term], 5)
    widest = torch.maximum(deviation(CAMERA.clamp(min=0.01)), free.deviation[0])
    wider = found.under(torch.zeros_like(free.mean[0]), widest)
    quadratic = Quadratic.of(total(wider, [term]) - prior(wider), wider)
    given = free if explained is None else explained
    index = torch.zeros(len(given), dtype=torch.long)
    return Posterior.of(fitted(quadratic, replace(given, T=found.T[index], noise=found.noise[index])), term, scatter)


def squared_errors(posteriors: list[Posterior]) -> Tensor:
    """Return squared errors in units of the covariances."""
    found = []
    for posterior in posteriors:
        error = (posterior.pose().inverse() @ TRUTH).log()
        found.append(error @ torch.linalg.solve(posterior.mixture(), error))
    return torch.stack(found)


@pytest.mark.parametrize(
    ("wide", "outliers"),
    [(deviation(0 * CAMERA), 0.3), (deviation(), 0.0)],
    ids=["known camera", "free camera"],
)
def test_the_covariance_is_that_of_many_trials(wide: Tensor, outliers: float) -> None:
    """Squared errors in units of the covariance are chi-squared with six degrees of freedom."""
    trials, draws, found = 60, Generator().manual_seed(0), []
    for seed in range(trials):
        z = torch.randn(len(NUISANCES), generator=draws, dtype=torch.float64)
        found.append(solved(matches(seed, outliers, wide * z), wide))
    squared = squared_errors(found)
    # The mean of n chi-squared variables with 6 degrees of freedom varies by sqrt(12 / n).
    assert float(squared.mean()) == pytest.approx(6, abs=4 * (12 / trials) ** 0.5)
    assert float((squared < 12.59).double().mean()) > 0.85  # 95 %


def test_more_matches_make_the_pose_more_certain_as_their_root() -> None:
    few, many = (solved(matches(0, m=m), deviation(0 * CAMERA)).mixture() for m in (100, 1600))
    ratio = float((few.trace() / many.trace()).sqrt())
    assert ratio == pytest.approx(4, rel=0.3)


def test_a_free_camera_makes_the_pose_less_certain() -> None:
    known, free = (solved(matches(0), wide).mixture() for wide in (deviation(0 * CAMERA), deviation()))
    root = torch.linalg.cholesky(torch.linalg.inv(known))
    assert float(torch.linalg.eigvalsh(root.mT @ free @ root)[0]) > 0.85  # each with its own noise
    assert float(free[2, 2]) > 4 * float(known[2, 2])  # along the optical axis


# Tolerance


def test_the_mass_grows_with_the_tolerance_up_to_what_is_credible() -> None:
    found, good = solved(matches(0)), torch.tensor([True])
    values = [found.mass(4.0 * share / TOLERANCE, NOTHING, good) for share in (0, 1e-4, 1e-3, 1e-2, 0.1)]
    assert values == sorted(values)
    assert values[0] == 0
    assert values[-1] == pytest.approx(1, abs=1e-6)
    assert 0.01 < values[2] < 0.99
    assert found.mass(4.0, NOTHING, torch.tensor([False])) == 0


def test_errors_of_the_map_take_mass_away() -> None:
    found, good = solved(matches(0)), torch.tensor([True])
    exact, shared = (found.mass(4.0 / 3, c, good) for c in (NOTHING, 0.04**2 * torch.eye(6).double()))
    assert shared < exact - 0.1


def test_what_is_undetermined_has_no_mass() -> None:
    found = solved(matches(0))
    for value in (torch.inf, torch.nan):
        broken = replace(found, covariance=torch.full_like(found.covariance, value))
        assert broken.mass(4.0, NOTHING, torch.tensor([True])) == 0


# Explanations


def test_the_explanation_that_fits_is_the_most_probable_one_and_the_mixture_holds_all() -> None:
    """The camera has another focal length: one explanation knows it, one knows nothing of it, one leaves it free."""
    true = torch.zeros(len(NUISANCES), dtype=torch.float64)
    true[0] = 0.03
    one = state(deviation(0 * CAMERA))
    known, wrong, free = (
        replace(one, mean=true[None]),
        one,
        state(deviation(0 * CAMERA).index_fill(0, torch.tensor([0]), 0.03)),
    )
    explained = States.cat([known, wrong, free])
    explained = replace(explained, row=torch.arange(3))
    found = solved(matches(0, nuisances=true), deviation(3 * CAMERA), explained=explained)
    assert found.best == 0
    assert float(found.probability[1]) < 1e-6
    assert float(found.probability[2]) > 0.01
    assert float(squared_errors([found])) < 22.5  # 99.9 %
    correction, certainty = found.camera_of(2)
    assert float(correction[0]) == pytest.approx(0.03, abs=4 * float(certainty[0]))
    assert float(certainty[0]) < 0.01


def test_prior_odds_and_evidence_of_landmarks_decide_between_places() -> None:
    term = matches(0)
    both = Landmarks(
        term.points.repeat(2, 1, 1),
        Sights(
            *(
                getattr(term.sights, n).expand(2, *getattr(term.sights, n).shape[1:])
                for n in ("image", "times", "rotation", "translation")
            )
        ),
        term.valid.repeat(2, 1),
        term.variance.repeat(2, 1),
        term.focal.repeat(2, 1),
        term.correlation.repeat(2),
        term.share.repeat(2),
        term.area,
        term.most_noise,
    )
    away = SE3.exp(torch.tensor([9.0, 0.0, 0.0, 0.0, 1.0, 0.0], dtype=torch.float64))
    both.points[1] = away.apply(both.points[1])
    few = both.valid.clone()
    few[1, 100:] = 0
    probability = {}
    for name, valid, odds in (("alike", both.valid, 0.0), ("start", both.valid, -20.0), ("fewer", few, 0.0)):
        given = replace(both, valid=valid)
        modes = States.cat([state(deviation()), state(deviation(), 1, away @ TRUTH)])
        modes, _ = descend(modes, [given], 8)
        quadratic = Quadratic.of(total(modes, [given]) - prior(modes), modes)
        log_odds = torch.tensor([0.0, odds], dtype=torch.float64)
        found = Posterior.of(fitted(quadratic, modes), given, NO_SCATTER, log_odds=log_odds)
        probability[name] = float(found.probability[found.states.mode == 1].sum())
        assert bool((found.place(1).translation - modes.T[1].translation).norm() < 0.05)
    assert probability["alike"] == pytest.approx(0.5, abs=1e-3)
    assert probability["start"] < 1e-8
    assert 1e-3 < probability["fewer"] < 0.05  # of two thirds as many matches


def test_the_pose_is_that_of_the_true_camera_where_the_apparent_one_is_spurious() -> None:
    """The part of an apparent focal length that errors of the landmarks explain does not move the pose."""
    true = torch.zeros(len(NUISANCES), dtype=torch.float64)
    true[0] = 0.02
    term, depths = matches(0, nuisances=true), []
    for scatter in (0.0, 0.02, 0.2):
        apparent = torch.hypot(CAMERA[:1], torch.tensor([scatter], dtype=torch.float64))
        wide = deviation(torch.cat([apparent, CAMERA[1:]]))
        all_of = torch.cat([torch.tensor([scatter], dtype=torch.float64), NO_SCATTER[1:]])
        found = solved(term, wide, all_of)
        error = (found.pose().inverse() @ TRUTH).log()
        depths.append((abs(float(error[2])), float(found.mixture()[2, 2].sqrt())))
        if scatter == 0.2:
            assert abs(float(found.states.nuisances[0, 0])) < 0.002
        if scatter == 0.0:
            assert float(found.states.nuisances[0, 0]) == pytest.approx(0.02, abs=0.008)
    errors, spreads = zip(*depths, strict=True)
    assert errors[2] > 0.05 > errors[0]  # 2 % of the distance, about
    assert spreads == tuple(sorted(spreads))


def test_the_pose_is_that_of_a_camera_at_rest_where_its_motion_is_spurious() -> None:
    motion = torch.zeros_like(NO_SCATTER)
    motion[6:12] = 0.005
    term = matches(0, nuisances=motion)
    free, spurious = (solved(term, motion, scatter).pose() for scatter in (NO_SCATTER, motion))
    still = solved(term, NO_SCATTER).pose()
    away = [float((pose.inverse() @ still).log().norm()) for pose in (free, spurious)]
    assert away[1] < 0.3 * away[0]  # the robust weights differ


DEGENERATE: dict[str, Callable[[Tensor], Tensor]] = {
    "at one place": lambda points: points[:, :1].expand_as(points),
    "on a line": lambda points: points[:, :1] + (points[:, 1:2] - points[:, :1]) * torch.linspace(0, 1, M)[:, None],
    "behind the camera": lambda points: 2 * TRUTH.translation - points,
    "not a number": lambda points: points * torch.nan,
}


@pytest.mark.parametrize("place", DEGENERATE)
def test_matches_that_do_not_determine_the_pose_never_leave_a_certain_one(place: str) -> None:
    term = matches(0)
    points = DEGENERATE[place](term.points)
    seen = project(state(deviation()), points, term.sights).image.nan_to_num(0.0)
    found = solved(replace(term, points=points, sights=replace(term.sights, image=seen)))
    covariance = found.mixture()
    assert not covariance.isnan().any()
    if bool(covariance.isfinite().all()):
        assert float(torch.linalg.eigvalsh(covariance)[0]) > 0
        assert float(covariance.diagonal().max()) > 1
    one = torch.ones(1, dtype=torch.bool)
    assert found.mass(4.0, NOTHING, one) < 0.5
