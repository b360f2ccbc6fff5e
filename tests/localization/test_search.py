"""Search without landmarks: halving keeps the best and a rival, hypotheses, and the poses found by points and by images."""

from __future__ import annotations

import math

import pytest
import torch

import baked
from bidnerf.results import pose_error
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import states_at
from bidnerf_core.localization.by_surface import by_images, hypotheses

# Inside: the distribution of proposals and the margin over other poses, of which an answer keeps one
from bidnerf_core.localization.search import Stage, halve
from bidnerf_core.mapping import Normal, P, States

PLACES = torch.tensor([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]], dtype=torch.float64)
OFFSETS = torch.tensor([0.0, 30.0], dtype=torch.float64)
MIDDLE = torch.tensor([0.0, 0.0, 4.0], dtype=torch.float64)


def two_valleys(states: States) -> Normal:
    """Return 100 times the squared distance to the nearer of two places, of which the second is worse by 30."""
    away = states.T.translation[:, None] - PLACES
    nearer = away.square().sum(-1).argmin(-1)
    off = away[torch.arange(len(away)), nearer]
    gradient, hessian = torch.zeros((len(off), P)).double(), torch.zeros((len(off), P, P)).double()
    gradient[:, :3] = 200 * (off[:, None] @ states.T.rotation)[:, 0]
    hessian[:, range(3), range(3)] = 200
    return Normal(100 * off.square().sum(-1) + OFFSETS[nearer], gradient, hessian)


def at(*x: float) -> States:
    places = torch.tensor([[value, 0.0, 0.0] for value in x], dtype=torch.float64)
    return states_at(SE3(torch.eye(3, dtype=torch.float64).expand(len(x), 3, 3), places))


STARTS = at(0.2, -0.1, 5.4, 0.3)


def test_the_best_is_found_and_the_margin_is_that_over_another_pose() -> None:
    stages = [Stage([two_valleys], 0, 3), Stage([two_valleys], 10, 2), Stage([two_valleys], 1, 1)]
    found = halve(STARTS, stages, MIDDLE)
    assert found.states.T.translation[0, 0].item() == pytest.approx(0, abs=1e-2)
    assert found.margin == pytest.approx(30, abs=0.1)
    assert found.rivals.T.translation[:, 0].tolist() == pytest.approx([5.0], abs=1e-2)
    assert torch.equal(found.path[0].matrix(), STARTS.T[1].matrix())
    assert torch.equal(found.path[-1].matrix(), found.states.T[0].matrix())
    assert len(found.path.translation) == len(found.losses) + 1
    assert bool((found.losses.diff() <= 0).all())
    assert math.isinf(halve(at(0.1), stages, MIDDLE).margin)


def test_a_rival_is_kept_where_all_others_are_the_same_answer() -> None:
    found = halve(STARTS, [Stage([two_valleys], 0, 2)], MIDDLE)
    assert found.states.T.translation[:, 0].tolist() == pytest.approx([-0.1, 5.4])


def test_a_stage_may_compare_poses_by_another_score() -> None:
    found = halve(STARTS, [Stage([two_valleys], 10, 1, lambda states: (states.T.translation[:, 0] - 5).abs())], MIDDLE)
    assert float(found.states.T.translation[0, 0]) == pytest.approx(5.0, abs=1e-2)


@pytest.mark.parametrize(("most", "complete"), [(1.1, True), (0.9, False)])
def test_a_search_ends_where_even_the_best_pose_is_worse_than_a_stage_allows(most: float, complete: bool) -> None:
    """The best of the starts costs 1."""
    found = halve(STARTS, [Stage([two_valleys], 0, 3, most=most), Stage([two_valleys], 10, 1)], MIDDLE)
    assert found.complete is complete
    assert float(found.states.T.translation[0, 0]) == pytest.approx(0.0 if complete else -0.1, abs=1e-2)
    assert len(found.states) == (1 if complete else 3)


@pytest.mark.parametrize("by_points", [True, False])
@pytest.mark.parametrize("count", [2, 33])
def test_hypotheses_are_distinct_and_begin_at_a_start(count: int, by_points: bool) -> None:
    view, surface = baked.unseen()[0], baked.toy()
    middle = torch.tensor([0.0, 0.0, 3.5])
    for start in (None, view.T_ref_camera):
        found = hypotheses(surface, start, middle, count, by_points, 0)
        assert found.translation.shape == (count, 3)
        assert found.is_rigid().all()
        assert len(torch.unique(found.matrix(), dim=0)) == count
        if start is not None:
            torch.testing.assert_close(found[0].matrix(), start.matrix())
    if by_points:
        last = hypotheses(surface, None, middle, 40, True, 0)[20:].apply(middle.double())
        centre = surface.surfels.positions.median(0).values.double()
        torch.testing.assert_close(last, centre.expand(20, 3), rtol=0, atol=1e-6)


def test_images_find_the_pose_without_depth() -> None:
    view = baked.unseen()[1]
    found, _ = by_images(baked.problem(view).without_depth(), baked.toy(), 64, 0)
    error = pose_error(found.states.T[0], view.T_ref_camera)
    # Of 3.5 m and with pixels and surfels that are 4 cm wide: what is left is the field's to take.
    assert float(error.translation) < 0.2
    assert float(error.rotation_deg) < 3
