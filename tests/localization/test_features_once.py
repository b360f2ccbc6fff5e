"""The keypoints of an image are found once a query, whatever is asked about the image, and once a capture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bidnerf_core import Localizer
from bidnerf_core.captures import tried_landmarks
from bidnerf_core.captures.relocated_photos import relocated
from bidnerf_core.frames import Frame
from bidnerf_core.localization import AutoConfig, mirror_image
from bidnerf_core.localization.tracking.relocalization import relocalized
from bidnerf_core.mapping import DEFAULT_LANDMARKS, FoundOnce, Keypoints, Sift, tracked_views
from bidnerf_core.testing import CAMERA, textured_map, training_views, unseen

Seen = list[Tensor]
QUICK = AutoConfig(fused_rays=256)


def localizer() -> Localizer:
    """Return one whose map hardly tells which focal length is right: estimates from its own images scatter."""
    scene = textured_map(surface=True)
    assert scene.landmarks is not None
    scatter = torch.full((4,), 0.01, dtype=torch.float64)
    landmarks = replace(scene.landmarks, calibration_scatter=scatter, correlation=1.0, cameras=(CAMERA,))
    return Localizer(replace(scene, landmarks=landmarks), config=QUICK, warm_up=False)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> Seen:
    """The images in which keypoints were sought."""
    images: Seen = []
    sought = Sift.__call__

    def noted(self: Sift, rgb: Tensor) -> Keypoints:
        images.append(rgb)
        return sought(self, rgb)

    monkeypatch.setattr(Sift, "__call__", noted)
    return images


def assert_all_differ(images: Seen) -> None:
    assert not any(torch.equal(a, b) for i, a in enumerate(images) for b in images[:i])


def photo() -> Frame:
    return replace(unseen().frame, depth=None)


def misstated() -> Frame:
    """A photo whose camera only renderings can judge: landmarks are searched with and without that evidence."""
    camera = photo().intrinsics
    return replace(photo(), intrinsics=replace(camera, fx=1.02 * camera.fx, fy=1.02 * camera.fy))


def behind_something() -> Frame:
    frame = unseen().frame
    rgb, depth = frame.rgb.clone(), frame.depth
    assert depth is not None
    depth = depth.clone()
    rgb[:, 40:], depth[:, 40:] = 0.5, 0.3
    return replace(frame, rgb=rgb, depth=depth)


@pytest.mark.parametrize(
    ("query", "images"),
    [
        (photo, 1),
        (misstated, 1),
        (lambda: mirror_image(photo()), 2),
        (behind_something, 2),
    ],
)
def test_a_query_finds_the_keypoints_of_its_image_and_of_the_mirror_image_at_most_once(
    query: Callable[[], Frame], images: int, searched: Seen
) -> None:
    localize, frame = localizer(), query()
    searched.clear()  # of making the map
    localize(frame)
    assert 1 <= len(searched) <= images
    assert_all_differ(searched)
    localize(frame)
    assert len(searched) <= 2 * images  # nothing stays of an earlier query


def test_a_lost_tracker_finds_the_keypoints_of_a_frame_once(searched: Seen) -> None:
    localize = localizer()
    searched.clear()
    relocalized(localize, mirror_image(photo()), None, 0, seed=0)
    assert_all_differ(searched)


@pytest.mark.slow
def test_photos_of_a_capture_are_searched_once(searched: Seen) -> None:
    views = training_views(10)
    tracked = tracked_views(views)
    assert len(searched) == len(views)
    tried_landmarks(tracked, views)
    assert len(searched) == len(views)
    relocated(tracked, views, [3], DEFAULT_LANDMARKS)
    assert len(searched) <= len(views) + 1  # the mirror image
    assert_all_differ(searched)


def test_equal_images_have_the_same_keypoints_and_others_their_own(searched: Seen) -> None:
    once, image = FoundOnce(Sift()), photo().rgb
    found = once(image)
    assert once(image) is found
    assert once(image.clone()) is found
    assert once(image.flip(1)) is not found
    assert len(searched) == 2
    assert FoundOnce(Sift(), [(image, found)])(image) is found
    assert len(searched) == 2
