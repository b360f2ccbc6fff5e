"""The comparison with another checkout: what is counted."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

from localizations import answer_row


@pytest.fixture
def alternate(script: Callable[[str], ModuleType]) -> Any:
    return script("alternate")


def row(seconds: float, error: float | None = 0.001, accepted: bool = True) -> Any:
    return answer_row(error, accepted, error, cpu_seconds=seconds)


def test_times_are_compared_question_by_question_and_wrong_answers_are_counted(alternate: Any) -> None:
    pairs = [
        {"old": row(1.0), "new": row(0.5)},
        {"old": row(1.0, 9.0), "new": row(0.5, 9.0, accepted=False)},
        {"old": row(8.0), "new": row(8.0, 9.0)},
    ]
    found = alternate.summary(pairs)
    assert found["cpu_ratio"] == pytest.approx(0.9)
    assert found["median_cpu_ratio"] == 0.5
    assert [(found[code]["right"], found[code]["silent"]) for code in ("old", "new")] == [(2, 1), (1, 1)]


def test_refusals_are_compared_with_accepted_answers_of_the_same_scene(alternate: Any) -> None:
    own = alternate.summary([{"old": row(1.0), "new": row(0.5)}])
    foreign = alternate.summary([{"old": row(9.0, None, False), "new": row(0.75, None, False)}])
    found = alternate.overall({"room, RGB": own, "room, RGB, other scenes": foreign})
    assert found == {
        "mean_cpu_ratio": 0.5,
        "largest_cpu_ratio": 0.5,
        "slowest_cpu_seconds": 0.75,
        "refusal_to_answer": 1.5,
    }
