"""How often a query and a tracked frame detect keypoints, match, fit and judge: upper bounds, which may only become lower.

Counts do not depend on the machine, as times do. The aim: keypoints once an image, at most 4 fits a query, and at most 2 a
tracked frame.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import pytest

from bidnerf_core import Tracker
from bidnerf_core.localization import LandmarkMatcher, Problem
from call_counts import CallCounts, functions
from flights import flight, localizer, without_depth
from pinned_landmarks import NOT_RENDERED, Case, ground_case
from problems import localize


class Most(NamedTuple):
    """Largest numbers of calls."""

    keypoints: int  # detections on one image
    matched: int  # searches for the landmarks nearest to keypoints
    fits: int
    other_cameras: int  # fits of another camera
    files: int  # of localization and mapping that are entered


COUNTED = {
    "matched": "LandmarkMatcher.nearest",
    "fits": "resect",
    "other_cameras": "better_camera",
}
KEYPOINTS = "Sift.__call__"

MOST = {
    "RGB":                                 Most(1, 3, 4, 1, 41),
    "RGB, rendered":                       Most(1, 3, 4, 1, 50),
    "RGB-D, rendered":                     Most(1, 3, 4, 1, 54),
    "RGB, misstated focal length":         Most(1, 3, 6, 1, 41),
    "RGB, rendered, doubtful focal length": Most(1, 5, 10, 2, 54),
    "RGB, rendered, approximate":          Most(1, 3, 6, 1, 50),
    "RGB, rendered, resized":              Most(1, 3, 18, 1, 50),
    "RGB, rendered, cropped":              Most(1, 6, 10, 2, 59),
    "RGB, rendered, moving rows":          Most(1, 2, 8, 1, 50),
    "RGB, rendered, mirrored":             Most(1, 4, 10, 2, 52),
    "first tracked frame, RGB-D":          Most(2, 3, 8, 1, 53),
    "tracked frame, RGB-D":                Most(0, 0, 1, 0, 32),
    "tracked frame, RGB":                  Most(0, 0, 1, 0, 26),
    "tracked frame with detection, RGB":   Most(1, 0, 2, 0, 28),
}  # fmt: skip

QUERIES: dict[str, Callable[[], Case]] = {
    "RGB": lambda: ground_case("none", config=NOT_RENDERED),
    "RGB, rendered": lambda: ground_case("none"),
    "RGB-D, rendered": lambda: ground_case("none", depth=True),
    "RGB, misstated focal length": lambda: ground_case("focal:0.95", config=NOT_RENDERED),
    "RGB, rendered, doubtful focal length": lambda: ground_case("focal:1.03"),
    "RGB, rendered, approximate": lambda: ground_case("nominal+focal:1.1"),
    "RGB, rendered, resized": lambda: ground_case("stretch:1.33"),
    "RGB, rendered, cropped": lambda: ground_case("crop:0.25"),
    "RGB, rendered, moving rows": lambda: ground_case("rolling-shutter:2"),
    "RGB, rendered, mirrored": lambda: ground_case("mirror"),
}


def counted(act: Callable[[], Any]) -> Most:
    found = CallCounts([KEYPOINTS, *COUNTED.values()]).running(act)
    calls = {column: found.calls[name] for column, name in COUNTED.items()}
    return Most(max(found.described.values(), default=0), **calls, files=len(found.files))


@functools.cache
def tracked(depth: bool) -> list[Most]:
    """Return the counts of the frames of a flight."""
    tracker = Tracker(localizer())
    frames = [(time, frame if depth else without_depth(frame)) for time, frame, _ in flight()]
    return [counted(functools.partial(tracker, frame, time)) for time, frame in frames]


def seen_anew(problem: Problem) -> Problem:
    """Return the problem as that of another query, which does not know the keypoints yet."""
    assert problem.matcher is not None
    return replace(problem, matcher=LandmarkMatcher(problem.matcher.landmarks).for_query())


def assert_within(found: Most, name: str) -> None:
    more = {key: value for key, value in found._asdict().items() if value > getattr(MOST[name], key)}
    assert more == {}, f"more calls than {MOST[name]}"


@pytest.mark.parametrize("name", QUERIES)
def test_a_query_does_nothing_more_often_than_it_did(name: str) -> None:
    case = QUERIES[name]()
    localize(case.problem, "auto", case.config)  # what is cached with the map
    again = seen_anew(case.problem)
    assert_within(counted(lambda: localize(again, "auto", case.config)), name)


@pytest.mark.parametrize("depth", [True, False], ids=["RGB-D", "RGB"])
def test_most_tracked_frames_do_nothing_more_often_than_they_did(depth: bool) -> None:
    mode, (first, *frames) = "RGB-D" if depth else "RGB", tracked(depth)
    followed = [found for found in frames if not found.keypoints]
    assert len(followed) >= len(frames) - 3
    for found in followed:
        assert_within(found, f"tracked frame, {mode}")
    if depth:
        assert_within(first, "first tracked frame, RGB-D")
    else:
        for found in frames:
            assert_within(found, "tracked frame with detection, RGB")


def test_what_is_counted_exists() -> None:
    assert {KEYPOINTS, *COUNTED.values()} <= functions()
