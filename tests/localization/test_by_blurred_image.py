"""Poses of blurred images, which are compared with renderings that are as blurred: a closed-form field, and photos of it.

The table of ``test_answers`` has blurred photos; ``refined_if_blurred`` is needed here for when blur is taken into account, and when not.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

import baked
from bidnerf_core.evaluation import faulty
from bidnerf_core.fields import Stratified, render_image
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import LandmarkMatcher, Localization, Outcome, Problem, Support, rig

# Inside: when blur is taken into account, and the filter that models it
from bidnerf_core.localization.by_blurred_image import BLURS, refined_if_blurred
from bidnerf_core.localization.costs.images import (
    ColourScales,
    FieldRenderer,
    ImageCost,
    gaussian_blurred,
    plain_pixel_costs,
    thumbnail,
)
from bidnerf_core.mapping import build_landmarks
from bidnerf_core.results import pose_error
from bidnerf_core.scenes import GaussianBlobs, orbit
from landmark_scene import Points, ring
from localizations import answer, assert_covered
from problems import FieldMap

CLOUDS = GaussianBlobs.random(12, density=400.0)
FIELD = replace(
    CLOUDS, widths=CLOUDS.widths / 2, waves=8 * CLOUDS.waves, sampler=Stratified(32, baked.BOUNDS)
)  # with sharp edges
CAMERA = baked.CAMERA
TRUTH = orbit(3.5, 3, elevation=(-10.0, 80.0), seed=7)[1]
ASIDE = TRUTH.retract(torch.tensor([0.03, -0.02, 0.03, 0.006, 0.006, -0.006], dtype=torch.float64))


@functools.cache
def photo(blur: float = 0.0, depth: bool = False) -> View:
    seen = render_image(FIELD, CAMERA, TRUTH, baked.BOUNDS)
    view = View(Frame("photo", seen.rgb, CAMERA, seen.depth if depth else None), TRUTH)
    return faulty(view, f"blur:{blur}", 0)


def problem(view: View) -> Problem:
    return rig(FieldMap(FIELD, baked.BOUNDS, baked.patch()), [view], None)  # any surface: none is rendered


@pytest.mark.slow
@pytest.mark.parametrize(("blur", "given"), [(1.5, Outcome.CONVERGED), (2.5, Outcome.IMPRECISE)])
def test_a_blurred_image_is_refined_and_judged_anew(blur: float, given: Outcome) -> None:
    found = refined_if_blurred(problem(photo(blur)), answer(ASIDE, given))
    error, before = (pose_error(T, TRUTH) for T in (found.T_world_camera, ASIDE))
    assert float(error.translation) < 0.3 * float(before.translation)
    assert float(error.rotation_deg) < 0.3
    assert found.converged, found.reason
    assert "blurred" in found.reason
    assert_covered(found.T_world_camera, TRUTH, found.covariance)
    assert found.steps == len(found.losses) == len(found.poses.translation) - 1
    torch.testing.assert_close(found.poses[-1].matrix(), found.T_world_camera.matrix())
    assert found.seconds > 1.0


LEFT: dict[str, tuple[Callable[[], Problem], Localization]] = {
    "sharp": (lambda: problem(photo()), answer(ASIDE)),
    "trusted": (lambda: problem(photo(2.0)), answer(ASIDE, confidence=0.99)),
    "mirrored": (lambda: problem(photo(2.0)), answer(ASIDE, Outcome.MIRRORED)),
    "miscalibrated": (lambda: problem(photo(2.0)), answer(ASIDE, Outcome.MISCALIBRATED)),
    "contradicted": (lambda: problem(photo(2.0)), answer(ASIDE, Outcome.TOO_FEW_MATCHES)),
    "without a surface": (lambda: replace(problem(photo(3.0)), surface=None), answer(ASIDE)),
    "by measured depth": (lambda: problem(photo(2.0, depth=True)), answer(ASIDE)),
    "in a blurred field": (lambda: replace(problem(photo(2.0)), colour_noise=0.1), answer(ASIDE)),
}


@pytest.mark.parametrize("name", LEFT)
def test_what_blur_does_not_explain_is_left_as_it_is(name: str) -> None:
    make, given = LEFT[name]
    assert refined_if_blurred(make(), given) is given


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "refined"), [(1.0, True), (1.05, False)])
def test_nor_one_with_intrinsics_that_differ_a_little_from_the_maps(factor: float, refined: bool) -> None:
    """A wrong focal length hardly shows in a blurred image, but moves the pose."""
    cameras = (replace(CAMERA, fx=factor * CAMERA.fx, fy=factor * CAMERA.fy),)
    points = Points()
    matcher = LandmarkMatcher(
        replace(build_landmarks(ring(points), points), cameras=cameras)
    )  # any landmarks
    given = answer(ASIDE)
    found = refined_if_blurred(replace(problem(photo(2.0)), matcher=matcher), given)
    assert (found is not given) == refined


@pytest.mark.slow
def test_a_blurred_image_of_which_much_shows_something_else_is_rejected() -> None:
    """Most of it is as the map has it, so that a blur is seen; the quarter in the middle has other colours."""
    view = photo(2.0)
    rgb = view.frame.rgb.clone()
    middle = slice(3 * CAMERA.height // 8, 5 * CAMERA.height // 8)
    rgb[middle] = 1 - rgb[middle]
    given = answer(TRUTH)
    found = refined_if_blurred(problem(View(replace(view.frame, rgb=rgb), TRUTH)), given)
    assert found is not given
    assert found.outcome is Outcome.RENDERING_MISMATCH
    assert "expected 75%" in found.reason
    assert isinstance(found.diagnostics, Support)
    assert found.diagnostics.explained < 0.75


def test_an_image_of_one_colour_tells_nothing() -> None:
    """It is explained best by the strongest blur, and by any pose."""
    plain = Frame("plain", torch.full((CAMERA.height, CAMERA.width, 3), 0.3), CAMERA)
    given = answer(ASIDE, Outcome.RENDERING_MISMATCH)
    assert refined_if_blurred(problem(View(plain, TRUTH)), given) is given


@pytest.mark.parametrize("blur", [1.0, 2.0])
def test_the_blur_is_found_from_a_pose_that_is_nearly_right(blur: float) -> None:
    small = thumbnail(View(photo(blur).frame, SE3.identity()), CAMERA.width)
    renderer = FieldRenderer(FIELD, baked.BOUNDS, torch.device("cpu"))
    cost = ImageCost(renderer, [small], ColourScales(colour=0.1), torch.tensor([0.0, 0.0, 3.5]))
    for T in (TRUTH, TRUTH.retract(torch.full((6,), 0.003, dtype=torch.float64))):
        assert cost.with_blur_of(T, BLURS).blur == blur


def test_blurring_adds_variances_and_keeps_the_mean(generator: Generator) -> None:
    image = torch.rand((1, 3, 40, 50), generator=generator, dtype=torch.float64)
    twice, once = gaussian_blurred(gaussian_blurred(image, 1.2), 1.6), gaussian_blurred(image, 2.0)
    inner = (..., slice(12, -12), slice(12, -12))
    torch.testing.assert_close(twice[inner], once[inner], rtol=0, atol=3e-3)
    flat = torch.full((1, 1, 9, 9), 0.3)
    torch.testing.assert_close(gaussian_blurred(flat, 3.0), flat)


def test_a_plain_image_has_no_cost_beside_images_of_one_colour(generator: Generator) -> None:
    def of(rgb: Tensor) -> float:
        frame = Frame("any", rgb, CAMERA)
        return float(plain_pixel_costs([thumbnail(View(frame, SE3.identity()), 24)], 0.1).mean())

    plain = torch.full((CAMERA.height, CAMERA.width, 3), 0.4)
    assert of(plain) == pytest.approx(0.0, abs=1e-6)
    parted = plain.clone()
    parted[:, : CAMERA.width // 4] = 0.9
    assert 0.2 < of(parted) < 0.3
