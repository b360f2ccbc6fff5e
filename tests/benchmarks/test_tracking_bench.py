"""The benchmarks of tracking: how sequences are shown, and how recovery is counted."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from types import ModuleType
from typing import Any

import pytest
import torch

from bidnerf import Frame, Intrinsics
from bidnerf_core.datasets import TimedFrame
from optional import require

CAMERA = Intrinsics(8.0, 8.0, 4.0, 3.0, 8, 6)


@pytest.fixture
def tracking(script: Callable[[str], ModuleType]) -> Any:
    return script("tracking")


def recording(count: int, photo_every: int = 1) -> list[TimedFrame]:
    """Return frames with depth, of which every few have colours, at uneven times."""
    return [
        TimedFrame(
            number + 0.1 * (number % 3),
            Frame(
                str(number),
                torch.full((6, 8, 3), 0.5),
                CAMERA,
                torch.ones(6, 8),
                has_colour=number % photo_every == 0,
            ),
        )
        for number in range(count)
    ]


def test_a_sequence_goes_back_and_forth_in_time_that_goes_on(tracking: Any) -> None:
    shown = list(tracking.back_and_forth(recording(5), 17))
    assert [timed.frame.name for timed in shown] == list("01234321012343210")
    steps = [b.time - a.time for a, b in pairwise(shown) if a.time is not None and b.time is not None]
    assert len(steps) == 16
    assert min(steps) > 0.5
    assert steps[:4] == pytest.approx(steps[4:8][::-1])


def test_covered_frames_are_the_blind_ones_and_sight_returns_after_them(tracking: Any) -> None:
    run = tracking.cover(recording(90, photo_every=3))
    dark = [float(timed.frame.rgb.max()) < 0.1 for timed in run.frames]
    assert [number for number, hidden in enumerate(dark) if hidden] == list(run.blind)
    assert run.returns == tracking.FIRST + 15
    photos = tracking.without_depth_frames(run)
    assert [float(timed.frame.rgb.max()) < 0.1 for timed in photos.frames] == [
        number in photos.blind for number in range(30)
    ]
    assert photos.frames[require(photos.returns)].frame.name == "57"


def test_depth_that_stops_takes_the_frames_of_depth_alone_with_it(tracking: Any) -> None:
    shown = tracking.depth_stops(recording(12, photo_every=3)).frames
    assert [timed.frame.name for timed in shown] == ["0", "1", "2", "3", "4", "5", "6", "9"]
    assert [timed.frame.depth is None for timed in shown] == [False] * 6 + [True] * 2


def test_carrying_leaves_no_trace_in_the_times(tracking: Any) -> None:
    run = tracking.carry_on(recording(200))
    assert run.returns == tracking.FIRST
    assert [timed.frame.name for timed in run.frames[tracking.FIRST - 1 : tracking.FIRST + 1]] == [
        "39",
        "140",
    ]
    before, after = run.frames[tracking.FIRST - 1].time, run.frames[tracking.FIRST].time
    assert require(after) - require(before) == pytest.approx(1.1)


@pytest.mark.parametrize(("accepted", "expected"), [("1101", 2), ("1011", 1), ("1000", 3)])
def test_recovery_counts_from_the_frame_in_which_sight_returns(tracking: Any, accepted: str, expected: int) -> None:
    rows: list[dict[str, Any]] = [{"accepted": letter == "1"} for letter in accepted]
    assert tracking.frames_until_accepted(rows, 2) == expected
