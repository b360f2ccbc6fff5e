"""Successive halving: the best pose wins, a runner-up may be kept, and the margin is that over a different pose."""

from __future__ import annotations

import math

import pytest
import torch

from bidnerf_core.geometry import SE3
from bidnerf_core.localization import NormalEquations, Pivot
from bidnerf_core.localization.search.halving import Distinct, SearchStage, search

PLACES = torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], dtype=torch.float64)
OFFSETS = torch.tensor([0.0, 0.3], dtype=torch.float64)
CAMERA = Pivot(SE3.identity())
DISTINCT = Distinct(torch.zeros(3), 1.0, 0.5)


def two_valleys(T: SE3) -> NormalEquations:
    """Return the squared distance to the nearer of two places, of which the second is worse by 0.3."""
    away = T.translation[:, None] - PLACES
    nearer = (away**2).sum(-1).argmin(-1)
    off = away[torch.arange(len(away)), nearer]
    turned = (T.rotation.mT @ off[..., None])[..., 0]
    hessian = torch.diag(torch.tensor([1.0, 1, 1, 0, 0, 0], dtype=torch.float64)).expand(len(off), 6, 6)
    return NormalEquations(
        (off**2).sum(-1) + OFFSETS[nearer], torch.cat([turned, torch.zeros_like(turned)], -1), hessian
    )


def at(*x: float) -> SE3:
    """Return poses along the x axis."""
    places = torch.tensor([[value, 0.0, 0.0] for value in x], dtype=torch.float64)
    return SE3(torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3), places)


START = at(0.2, -0.1, 5.4, 0.3)
RANKED, DESCENDED = (
    SearchStage(two_valleys, CAMERA, 0, 2, 1e-2),
    SearchStage(two_valleys, CAMERA, 10, 2, 1e-2),
)


def test_a_runner_up_that_is_kept_measures_the_margin() -> None:
    found = search(START, [RANKED, DESCENDED], DISTINCT, keep_runner_up=True)
    assert found.T.translation[:, 0].tolist() == pytest.approx([0.0, 5.0], abs=1e-6)
    assert found.scores.tolist() == pytest.approx([0.0, 0.3], abs=1e-9)
    assert found.margin == pytest.approx(0.3, abs=1e-9)


def test_without_a_runner_up_the_best_poses_stay() -> None:
    found = search(START, [RANKED, DESCENDED], DISTINCT, keep_runner_up=False)
    assert float(found.T.translation[:, 0].abs().max()) < 1e-6
    assert math.isinf(found.margin)


def test_the_last_stage_with_different_poses_tells_the_margin() -> None:
    stages = [DESCENDED, SearchStage(two_valleys, CAMERA, 2, 1, 1e-2)]
    found = search(START, stages, DISTINCT, keep_runner_up=False)
    assert len(found.T.translation) == 1
    assert found.margin == pytest.approx(0.3, abs=1e-9)


def test_the_path_leads_from_the_winning_hypothesis_to_the_answer() -> None:
    found = search(START, [RANKED, DESCENDED], DISTINCT, keep_runner_up=True)
    assert torch.equal(found.path[0].matrix(), START[1].matrix())
    assert torch.equal(found.path[-1].matrix(), found.T[0].matrix())
    assert len(found.path.translation) == 11
    assert len(found.losses) == 10
    assert bool((found.losses.diff() <= 0).all())
    assert float(found.losses[0]) == pytest.approx(0.01)


def test_a_stage_may_compare_poses_by_another_score() -> None:
    """Steps follow the cost; the score decides which pose is best, and is reported."""

    def score(T: SE3) -> torch.Tensor:
        return (T.translation[:, 0] - 5).abs()

    stage = SearchStage(two_valleys, CAMERA, 10, 1, 1e-2, score=score)
    found = search(START, [stage], DISTINCT, keep_runner_up=False)
    assert float(found.T.translation[0, 0]) == pytest.approx(5.0, abs=1e-6)
    assert float(found.scores[0]) == pytest.approx(0.0, abs=1e-6)


def test_poses_differ_by_where_they_put_what_is_seen_or_by_their_angle() -> None:
    """A turn about what is seen moves it nowhere, and counts by its angle."""
    about = Pivot.at_point(torch.tensor([0.0, 0.0, 3.0]))
    xi = torch.zeros((5, 6), dtype=torch.float64)
    xi[1, 0], xi[2, 0], xi[3, 4], xi[4, 4] = 0.9, 1.1, 0.45, 0.55
    different = Distinct(torch.tensor([0.0, 0.0, 3.0]), 1.0, 0.5)
    poses = about.moved(at(*[2.0] * 5), xi)
    assert different(poses).tolist() == [False, False, True, False, True]
