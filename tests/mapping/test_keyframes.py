"""Keyframes that a field renders, and how well it renders the images that it was trained on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch

from balls import HomogeneousBall
from bidnerf import SE3, View

# Inside: the limits on the number and size of keyframes, which a map does not state
from bidnerf.scenes import orbit
from bidnerf.testing import BOUNDS, GROUND_CAMERA, ground, training_views, unseen
from bidnerf_core.camera import Intrinsics
from bidnerf_core.fields import SceneBounds, Stratified
from bidnerf_core.localization import LandmarkMatcher, Loop
from bidnerf_core.mapping import build_landmarks, colour_noise, render_views
from localizations import assert_near
from optional import require

BALL = HomogeneousBall(0.5, 400.0, rgb=(0.8, 0.3, 0.2), sampler=Stratified(256))
CUBE = SceneBounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0), 0.1, 8.0)
TINY = Intrinsics(6.0, 6.0, 2.5, 2.5, 5, 5)


def test_keyframes_show_the_field_from_the_cameras() -> None:
    cameras = [(TINY, T) for T in orbit(2.0, 3)]
    found = render_views(BALL, CUBE, cameras)
    assert len(found) == 3
    for view, (intrinsics, T) in zip(found, cameras, strict=True):
        assert view.frame.intrinsics == intrinsics
        assert torch.equal(view.T_ref_camera.matrix(), T.matrix())
        depth = require(view.frame.depth)
        assert float(depth[2, 2]) == pytest.approx(1.5, abs=0.02)  # the nearest point of the ball
        torch.testing.assert_close(view.frame.rgb[2, 2], torch.tensor(BALL.rgb), rtol=0, atol=0.5 / 255)
        assert float(depth[0, 0]) == 0  # past the ball
    assert len({view.frame.name for view in found}) == 3


def test_keyframes_are_as_many_and_as_large_as_is_useful_at_most() -> None:
    """Many cameras are thinned out evenly, and a large image is rendered with fewer pixels."""
    cameras = [(TINY, T) for T in orbit(2.0, 201)]
    found = render_views(HomogeneousBall(0.5, 1.0, sampler=Stratified(1)), CUBE, cameras)
    assert len(found) <= 100
    assert torch.equal(found[1].T_ref_camera.matrix(), cameras[3][1].matrix())
    large = Intrinsics(2400.0, 2400.0, 1200.0, 5.0, 2400, 10)
    small = render_views(HomogeneousBall(0.5, 1.0, sampler=Stratified(1)), CUBE, [(large, orbit(2.0, 1)[0])])
    camera = small[0].frame.intrinsics
    assert camera.width == 400
    assert camera.width / camera.fx == pytest.approx(large.width / large.fx)
    assert small[0].frame.rgb.shape[:2] == (camera.height, camera.width)


def test_landmarks_of_keyframes_find_a_photo() -> None:
    """They stand in for the photos of a map that came without."""
    views = render_views(ground(), BOUNDS, [(GROUND_CAMERA, view.T_ref_camera) for view in training_views()[:6]])
    found = require(Loop([View(unseen().frame, SE3.identity())], LandmarkMatcher(build_landmarks(views)))())
    assert_near(found.T_world_rig, unseen().T_ref_camera, 0.02, 0.5)


def brighter(views: tuple[View, ...], by: float) -> list[View]:
    return [replace(view, frame=replace(view.frame, rgb=view.frame.rgb + by)) for view in views]


def difference(views: Sequence[View], others: Sequence[View]) -> float:
    """Return the root mean square difference of the colours, which bytes limit to what they can hold."""
    pairs = [(a.frame.rgb - b.frame.rgb).square().mean() for a, b in zip(views, others, strict=True)]
    return float(torch.stack(pairs).mean().sqrt())


@pytest.mark.parametrize("off", [0.0, 0.1, -0.25])
def test_colour_noise_is_the_root_mean_square_error(off: float) -> None:
    some = training_views()[:3]
    changed = brighter(some, off)
    assert colour_noise(ground(), BOUNDS, changed) == pytest.approx(difference(changed, some), abs=0.5 / 255)


def test_colour_noise_is_that_of_all_views_together() -> None:
    """A quarter of the squared error where half of the images are off by as much as all were."""
    some = training_views()[:4]
    changed = brighter(some[2:], 0.2)
    found = colour_noise(ground(), BOUNDS, [*some[:2], *changed])
    assert found == pytest.approx(difference(changed, some[2:]) / math.sqrt(2), rel=0.05)


def test_colour_noise_needs_no_seed_and_keeps_no_gradient() -> None:
    some = training_views()[:2]
    first = colour_noise(ground(1), BOUNDS, some)
    torch.manual_seed(99)
    assert colour_noise(ground(1), BOUNDS, some) == first
    assert first > 0.1  # another ground
