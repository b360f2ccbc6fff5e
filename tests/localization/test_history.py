"""The history of a descent: when to stop, and which pose to answer with."""

from __future__ import annotations

import math

import pytest
import torch

from bidnerf_core.geometry import SE3
from bidnerf_core.localization.solvers.history import WINDOW, History


def history(losses: list[float]) -> History:
    """Return a history with these losses and a centimetre along x a step."""
    poses = [
        SE3.exp(torch.tensor([0.01 * i, 0, 0, 0, 0, 0], dtype=torch.float64)) for i in range(len(losses) + 1)
    ]
    return History(poses, losses)


def test_the_best_pose_is_where_the_mean_loss_was_least() -> None:
    losses = [1.0] * 30 + [0.2] * WINDOW + [0.5] * 30
    losses[5] = 0.0  # one lucky draw is not the best
    way = history(losses)
    T, mean = way.answer("best")
    assert mean == pytest.approx(0.2)
    assert float(T.translation[0]) == pytest.approx(0.01 * (30 + WINDOW - 1))
    T, mean = way.answer("last")
    assert float(T.translation[0]) == pytest.approx(0.01 * len(losses))
    assert mean == pytest.approx(0.5)


def test_a_short_history_answers_with_its_end() -> None:
    T, mean = history([0.1, 5.0]).answer("best")
    assert float(T.translation[0]) == pytest.approx(0.02)
    assert mean == pytest.approx(2.55)
    assert math.isnan(history([]).answer("best")[1])


def test_the_length_of_steps_is_measured() -> None:
    assert history([1.0] * 40).recent_step() == pytest.approx(0.01)
    assert history([1.0] * 40).stop(0.0, 0.011) is not None
    assert history([1.0] * 40).stop(0.0, 0.009) is None
    assert history([1.0] * (WINDOW - 1)).stop(10.0, 10.0) is None
    assert history([]).recent_step() == math.inf


def test_a_batch_adds_its_best_pose_after_each_step() -> None:
    """Two poses over two steps; the history gets half of each cost, as the loss that Adam reports."""
    xi = torch.zeros((3, 2, 6), dtype=torch.float64)
    xi[..., 0] = torch.tensor([[0.0, 10.0], [1.0, 11.0], [2.0, 12.0]])
    costs = torch.tensor([[4.0, 6.0], [3.0, 2.0], [1.0, 2.0]], dtype=torch.float64)
    seen = History([SE3.identity()])
    seen.add_batch(SE3.exp(xi), costs)
    assert [float(T.translation[0]) for T in seen.poses] == pytest.approx([0.0, 11.0, 2.0])
    assert seen.losses == [2.0, 1.0]
