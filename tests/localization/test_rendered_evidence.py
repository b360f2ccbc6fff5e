"""Evidence by renderings: which of two cameras took an image, and whether it is mirrored, where keypoints do not tell.

The table of ``test_answers`` has what ``auto`` makes of it; ``log_odds_by_rendering`` is needed here for the odds themselves.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import pytest
import torch

from bidnerf_core import Intrinsics, Localizer, Outcome, View
from bidnerf_core.fields import FieldValues
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import (
    AutoConfig,
    Problem,
    mirror_image,
    rig,
)

# Inside: the log odds of two poses, which an answer only compares with zero
from bidnerf_core.localization.alternatives import NOISIEST, log_odds_by_rendering
from bidnerf_core.testing import CAMERA, TexturedGround, textured_map, unseen
from conditions import ground_landmarks


def stated(factor: float) -> Intrinsics:
    return replace(CAMERA, fx=CAMERA.fx * factor, fy=CAMERA.fy * factor)


def problem(camera: Intrinsics = CAMERA, mirrored: bool = False) -> Problem:
    """An image of the ground as seen with a camera, from about the pose that suits it best."""
    view = unseen()
    frame = replace(view.frame, intrinsics=camera)
    distance = float(view.T_ref_camera.translation.norm())
    nearer = torch.tensor([0, 0, distance * (1 - camera.fx / CAMERA.fx), 0, 0, 0], dtype=torch.float64)
    start = view.T_ref_camera.retract(nearer)
    return rig(
        textured_map(), [View(mirror_image(frame) if mirrored else frame, SE3.identity())], start
    ).without_depth()


@functools.cache
def odds_against(factor: float) -> float:
    """Return the log odds of the camera that took the image against one of another focal length."""
    return log_odds_by_rendering(problem(), problem(stated(factor)), seed=0)


@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_the_camera_that_took_the_image_is_told_from_another(factor: float) -> None:
    assert odds_against(factor) > 3


def test_the_odds_of_one_are_those_against_the_other() -> None:
    a, b = problem(), problem(stated(1.01))
    assert log_odds_by_rendering(a, b, seed=0) == pytest.approx(-log_odds_by_rendering(b, a, seed=0))
    assert log_odds_by_rendering(a, a, seed=0) == 0


class NotFinite(TexturedGround):
    def query(self, positions: torch.Tensor, directions: torch.Tensor) -> FieldValues:
        values = super().query(positions, directions)
        return replace(values, rgb=values.rgb * torch.nan)


def test_an_image_is_told_from_its_mirror_image() -> None:
    assert log_odds_by_rendering(problem(), problem(mirrored=True), seed=0) > 5


def test_exposure_does_not_change_what_an_image_tells() -> None:
    def darker(given: Problem) -> Problem:
        return replace(
            given,
            views=tuple(replace(v, frame=replace(v.frame, rgb=0.7 * v.frame.rgb)) for v in given.views),
        )

    assert log_odds_by_rendering(darker(problem()), darker(problem(stated(1.03))), seed=0) > 3


def test_a_part_of_an_image_tells_less_than_the_whole() -> None:
    rows = torch.ones((CAMERA.height, CAMERA.width), dtype=torch.bool)
    rows[:8] = False  # a twelfth of the image is left

    def hidden(given: Problem) -> Problem:
        (view,) = given.views
        return replace(given, views=(replace(view, frame=replace(view.frame, hidden=rows)),))

    assert log_odds_by_rendering(
        hidden(problem()), hidden(problem(stated(1.03))), seed=0
    ) < 0.6 * odds_against(1.03)


@pytest.mark.parametrize(
    "changes",
    [{"field": NotFinite()}, {"colour_noise": 1.01 * NOISIEST}],
    ids=["not finite", "hardly trained"],
)
def test_a_field_that_renders_nothing_sound_tells_nothing(changes: dict[str, Any]) -> None:
    a, b = (replace(given, **changes) for given in (problem(), problem(stated(1.03))))
    assert log_odds_by_rendering(a, b, seed=0) == 0
    c, d = (replace(given, colour_noise=0.99 * NOISIEST) for given in (problem(), problem(stated(1.03))))
    assert log_odds_by_rendering(c, d, seed=0) > 1


def test_intrinsics_that_renderings_contradict_are_estimated() -> None:
    """The map does not say which cameras took its images, so that there is no other hypothesis."""
    scene = replace(textured_map(), landmarks=replace(ground_landmarks(scatter=0.007), cameras=()))
    photo = replace(unseen().frame, depth=None, intrinsics=stated(1.08))
    alone, rendered = (
        Localizer(scene, config=AutoConfig(fused_rays=rays), warm_up=False)(photo, unseen().T_ref_camera)
        for rays in (0, 1024)
    )
    assert alone.outcome is Outcome.MISCALIBRATED
    assert rendered.outcome is not Outcome.MISCALIBRATED
    assert rendered.intrinsics is not None
    assert rendered.focal_factor == pytest.approx(1 / 1.08, rel=0.03)
