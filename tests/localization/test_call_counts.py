"""How often a query and a tracked frame detect keypoints, match and fit: upper bounds, which may only become lower.

Counts do not depend on the machine, as times do. Detections are counted by a detector that is registered as a plugin. Matching and
fitting have no such seam: calls of ``LandmarkMatcher.nearest`` and of ``mapping.resect`` are counted by their names, wherever they
are called. The aim: keypoints once an image, at most 4 fits a query, and at most 2 a tracked frame.
"""

from __future__ import annotations

import functools
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import FrameType
from typing import Any, NamedTuple

import pytest
import torch

from bidnerf_core import Frame, Localization, Localizer, Tracker, View
from bidnerf_core.captures import tried_landmarks

# Inside: relocates single photos, to count the detections in that step alone
from bidnerf_core.captures.relocated_photos import relocated
from bidnerf_core.localization import LandmarkMatcher
from bidnerf_core.mapping import DEFAULT_LANDMARKS, FoundOnce, LandmarkMap, resect, tracked_views
from bidnerf_core.registry import registered
from bidnerf_core.testing import textured_map, training_views, unseen
from conditions import NOT_RENDERED, QUICK, CountedDetector, ground_landmarks, ground_views, with_landmarks
from flights import FRAMES, assert_right, flight, flight_pose, without_depth


class Calls(NamedTuple):
    """Numbers of calls."""

    keypoints: int  # detections on one image
    matched: int  # searches for the landmarks nearest to keypoints
    fits: int


MOST = {
    "RGB":                                 Calls(1, 3, 4),
    "RGB, rendered":                       Calls(1, 3, 4),
    "RGB-D, rendered":                     Calls(1, 3, 4),
    "RGB, misstated focal length":         Calls(1, 3, 6),
    "RGB, rendered, doubtful focal length": Calls(1, 5, 10),
    "RGB, rendered, approximate":          Calls(1, 3, 6),
    "RGB, rendered, resized":              Calls(1, 3, 18),
    "RGB, rendered, cropped":              Calls(1, 6, 10),
    "RGB, rendered, moving rows":          Calls(1, 2, 8),
    "RGB, rendered, mirrored":             Calls(1, 4, 10),
    "first tracked frame, RGB-D":          Calls(2, 3, 8),
    "tracked frame, RGB-D":                Calls(0, 0, 1),
    "tracked frame, RGB":                  Calls(0, 0, 1),
    "tracked frame with detection, RGB":   Calls(1, 0, 2),
}  # fmt: skip

QUERIES: dict[str, tuple[str, bool, Any]] = {
    "RGB": ("none", False, NOT_RENDERED),
    "RGB, rendered": ("none", False, QUICK),
    "RGB-D, rendered": ("none", True, QUICK),
    "RGB, misstated focal length": ("focal:0.95", False, NOT_RENDERED),
    "RGB, rendered, doubtful focal length": ("focal:1.03", False, QUICK),
    "RGB, rendered, approximate": ("nominal+focal:1.1", False, QUICK),
    "RGB, rendered, resized": ("stretch:1.33", False, QUICK),
    "RGB, rendered, cropped": ("crop:0.25", False, QUICK),
    "RGB, rendered, moving rows": ("rolling-shutter:2", False, QUICK),
    "RGB, rendered, mirrored": ("mirror", False, QUICK),
}


@pytest.fixture
def detector(monkeypatch: pytest.MonkeyPatch) -> CountedDetector:
    """The detector "counted"."""
    found = CountedDetector()
    monkeypatch.setitem(registered, ("features", "counted"), found)
    return found


def localizer(config: Any = QUICK, landmarks: LandmarkMap | None = None) -> Localizer:
    """Return one whose map has the landmarks of the detector "counted"."""
    scene = with_landmarks(landmarks or ground_landmarks("counted"))
    return Localizer(scene, config=config, warm_up=False)


def counted(detector: CountedDetector, act: Callable[[], Any]) -> Calls:
    names, calls = {f.__code__: f.__name__ for f in (LandmarkMatcher.nearest, resect)}, Counter[str]()

    def called(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and frame.f_code in names:
            calls[names[frame.f_code]] += 1

    detector.images.clear()
    sys.setprofile(called)
    try:
        act()
    finally:
        sys.setprofile(None)
    return Calls(detector.most_often, calls["nearest"], calls["resect"])


def assert_within(found: Calls, name: str) -> None:
    more = {key: value for key, value in found._asdict().items() if value > getattr(MOST[name], key)}
    assert more == {}, f"more calls than {MOST[name]}"


@pytest.mark.parametrize("name", QUERIES)
def test_a_query_does_nothing_more_often_than_it_did(name: str, detector: CountedDetector) -> None:
    fault, depth, config = QUERIES[name]
    localize, views = localizer(config), ground_views(fault, depth=depth)
    found = counted(detector, lambda: localize(views))
    assert_within(found, name)
    assert found.keypoints == 1
    assert found.matched > 0
    assert found.fits > 0


@pytest.mark.parametrize("depth", [True, False], ids=["RGB-D", "RGB"])
def test_most_tracked_frames_do_nothing_more_often_than_they_did(
    depth: bool, detector: CountedDetector
) -> None:
    """The optical flow carries landmarks on; keypoints are detected where these become few."""
    mode, tracker = "RGB-D" if depth else "RGB", Tracker(localizer(None))
    frames = [(time, frame if depth else without_depth(frame)) for time, frame, _ in flight()]
    first, *others = (counted(detector, functools.partial(tracker, f, time)) for time, f in frames)
    followed = [found for found in others if not found.keypoints]
    assert len(followed) >= FRAMES - 4
    assert tracker.tracking
    for found in followed:
        assert_within(found, f"tracked frame, {mode}")
    if depth:
        assert_within(first, "first tracked frame, RGB-D")
    else:
        for found in others:
            assert_within(found, "tracked frame with detection, RGB")


def test_a_start_replaces_the_search_of_a_tracker(detector: CountedDetector) -> None:
    start = flight_pose(0).retract(torch.tensor([0.01, -0.01, 0.01, 0.01, 0.01, -0.02], dtype=torch.float64))
    landmarks = textured_map().landmarks
    assert landmarks is not None
    localize = localizer(None, replace(landmarks, features="counted"))
    tracker, frames, answers = Tracker(localize, start=start), flight()[:3], list[Localization]()
    (time, frame, _), *others = frames
    started = counted(detector, lambda: answers.append(tracker(frame, time)))
    searched = counted(detector, lambda: Tracker(localize)(frame, time))
    assert started.matched <= 1 < searched.matched  # landmarks in view are matched, not those of the map
    answers += [tracker(frame, time) for time, frame, _ in others]
    assert_right(answers, frames)


def behind_something() -> Frame:
    frame = unseen().frame
    rgb, depth = frame.rgb.clone(), frame.depth
    assert depth is not None
    depth = depth.clone()
    rgb[:, 40:], depth[:, 40:] = 0.5, 0.3
    return replace(frame, rgb=rgb, depth=depth)


@pytest.mark.parametrize(
    "query", [lambda: ground_views("mirror"), lambda: [View(behind_something(), unseen().T_ref_camera)]]
)
def test_the_image_and_one_changed_image_are_searched_once_each_in_every_query(
    query: Callable[[], list[View]], detector: CountedDetector
) -> None:
    localize = localizer()
    for times in (1, 2):  # nothing stays of an earlier query
        localize(query())
        assert 1 <= len(detector.images) <= 2 * times
        assert detector.most_often == times


def test_a_lost_tracker_finds_the_keypoints_of_a_frame_once(detector: CountedDetector) -> None:
    tracker = Tracker(localizer())
    (view,) = ground_views("mirror")
    assert not tracker(view.frame, 0.0).converged
    assert detector.most_often == 1


@pytest.mark.slow
def test_photos_of_a_capture_are_searched_once() -> None:
    detector, views = CountedDetector(), training_views(10)
    tracked = tracked_views(views, detector)
    assert len(detector.images) == len(views)
    tried_landmarks(tracked, views)
    assert len(detector.images) == len(views)
    relocated(tracked, views, [3], DEFAULT_LANDMARKS)
    assert len(detector.images) <= len(views) + 1  # the mirror image
    assert detector.most_often == 1


def test_equal_images_have_the_same_keypoints_and_others_their_own() -> None:
    detector, image = CountedDetector(), unseen().frame.rgb
    once = FoundOnce(detector)
    found = once(image)
    assert once(image) is found
    assert once(image.clone()) is found
    assert once(image.flip(1)) is not found
    assert len(detector.images) == 2
    assert FoundOnce(detector, [(image, found)])(image) is found
    assert len(detector.images) == 2
