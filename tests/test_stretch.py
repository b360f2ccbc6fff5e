"""Stretched images: told from the matches that a pose leaves out, rejected by ``auto``, and not seen where there are none."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
import torch
from torch import Generator

from bidnerf_core import Outcome
from bidnerf_core.localization import AutoConfig
from bidnerf_core.localization.problem import rig
from bidnerf_core.localization.search.matching import LandmarkMatcher
from bidnerf_core.localization.search.stretch import LEAST_STRETCH, UNSUSPECTED, stretch_of
from bidnerf_core.mapping.observed_points import ObservedPoints
from bidnerf_core.se3 import SE3
from problems import localize
from textured_field import textured_map, unseen

FOCAL = 500.0
LIMIT = 2.0
TRUTH = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.1, 0.2, -0.1], dtype=torch.float64))


def matches(stretch: float, generator: Generator, count: int = 200, wrong: int = 40) -> ObservedPoints:
    """Return points before the camera, seen in an image that is stretched in width, some of them matched wrongly."""
    local = torch.rand((count, 3), generator=generator, dtype=torch.float64) * 2 - 1
    local[:, 2] += 4
    image = local[:, :2] / local[:, 2:] * torch.tensor([stretch, 1.0])
    image = image + 0.3 / FOCAL * torch.randn((count, 2), generator=generator, dtype=torch.float64)
    image[:wrong] = torch.rand((wrong, 2), generator=generator, dtype=torch.float64) * 0.5 - 0.25
    each = torch.ones(count, dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    sight = torch.nn.functional.normalize(TRUTH.rotate(local), dim=-1)
    return ObservedPoints(
        TRUTH.apply(local), 1e-3 * torch.ones((count, 2), dtype=torch.float64), sight, image, FOCAL * each,
        0 * each, eye, torch.zeros((count, 3), dtype=torch.float64),
    )  # fmt: skip


def agreeing(data: ObservedPoints, T: SE3) -> int:
    return int((torch.linalg.vector_norm(data.residuals(T), dim=-1) <= LIMIT).sum())


@pytest.mark.parametrize("stretch", [0.6, 0.9, 1.1, 1.5])
def test_a_stretch_is_estimated_from_a_pose_that_few_matches_agree_with(
    stretch: float, generator: Generator
) -> None:
    data = matches(stretch, generator)
    found = stretch_of(data, TRUTH, LIMIT, agreeing(data, TRUTH))
    assert found == pytest.approx(stretch, rel=0.01)


def test_images_that_are_not_stretched_are_not_suspected(generator: Generator) -> None:
    for wrong in (0, 40, 120):
        data = matches(1.0, generator, wrong=wrong)
        assert stretch_of(data, TRUTH, LIMIT, agreeing(data, TRUTH)) == 1


def test_garbage_has_no_stretch_and_does_no_harm(generator: Generator) -> None:
    """Points at, behind and far beyond the camera, matched at random."""
    data = matches(1.0, generator, wrong=200)
    odd = data.points.clone()
    odd[::4], odd[1::4] = TRUTH.translation, 1e12 * odd[1::4]
    odd[2::4] = TRUTH.apply(torch.tensor([0.3, 0.1, 1e-300], dtype=torch.float64))
    assert stretch_of(replace(data, points=odd), TRUTH, LIMIT, 10) == 1


def test_a_stretch_within_the_errors_of_lenses_is_not_told(generator: Generator) -> None:
    data = matches(1 + 0.5 * LEAST_STRETCH, generator, wrong=100)
    assert stretch_of(data, TRUTH, LIMIT, 20) == 1


def test_a_pose_that_most_matches_agree_with_is_not_questioned(generator: Generator) -> None:
    data = matches(1.2, generator)
    most = int(UNSUSPECTED * len(data)) + 1
    assert stretch_of(data, TRUTH, LIMIT, most) == 1
    assert stretch_of(data, TRUTH, LIMIT, 0) == 1


@pytest.mark.parametrize("stretch", [0.75, 1.33])
def test_auto_rejects_a_stretched_image(stretch: float) -> None:
    view = replace(unseen(), frame=replace(unseen().frame, depth=None))
    camera = replace(view.frame.intrinsics, fx=view.frame.intrinsics.fx / stretch)
    landmarks = textured_map().landmarks
    assert landmarks is not None
    matcher = LandmarkMatcher(replace(landmarks, calibration_scatter=torch.full((4,), 0.01).double()))
    problem = rig(textured_map(), [replace(view, frame=replace(view.frame, intrinsics=camera))], None)
    found = localize(replace(problem, matcher=matcher), "auto", AutoConfig(fused_rays=0))
    assert found.outcome is Outcome.MISCALIBRATED
    told = re.search(r"were (\d+)% (wider|narrower) than its camera says", found.reason)
    assert told is not None
    assert int(told[1]) == pytest.approx(100 * abs(stretch - 1), abs=2)
    assert (told[2] == "wider") is (stretch > 1)
