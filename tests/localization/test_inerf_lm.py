"""Method ``inerf-lm`` on a closed-form scene: poses by colour alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.evaluation import perturb
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import settings_of
from bidnerf_core.results import pose_error
from blob_images import BOUNDS, FIELD, FRAME, TRUTH
from problems import localize, single


def test_colour_alone_finds_a_place_that_is_near() -> None:
    start = perturb(TRUTH, 0.1, 3.0, seed=2)
    config = {"poses": 8, "search_poses": 2, "middle_poses": 2, "coarse_rays": 128, "fine_rays": 512}
    answers = [
        localize(single(FIELD, BOUNDS, frame, start), "inerf-lm", config)
        for frame in (FRAME, replace(FRAME, depth=None), replace(FRAME, depth=torch.full((40, 48), 9.0)))
    ]
    assert float(pose_error(answers[0].T_world_camera, TRUTH).translation) < 0.03
    for other in answers[1:]:  # depth is not used
        assert torch.equal(other.T_world_camera.matrix(), answers[0].T_world_camera.matrix())


def test_colour_alone_finds_a_place_that_is_far() -> None:
    """A camera that was turned by 30 degrees sees next to nothing of what it saw."""
    start = TRUTH @ SE3.exp(torch.tensor([0.1, -0.1, 0.1, 0.0, 0.5, 0.1], dtype=torch.float64))
    blind = single(FIELD, BOUNDS, replace(FRAME, depth=None), start)
    config = {"poses": 96, "search_poses": 8, "middle_poses": 3, "coarse_rays": 128, "fine_rays": 512}
    found = localize(blind, "inerf-lm", config)
    assert float(pose_error(found.T_world_camera, TRUTH).translation) < 0.03
    assert found.converged, found.reason
    assert found.steps == len(found.losses) == len(found.poses.translation) - 1
    assert torch.equal(found.poses[0].matrix(), start.matrix())


@pytest.mark.parametrize(
    ("setting", "value"),
    [("poses", 0), ("search_poses", 0), ("middle_steps", 0), ("width", 3), ("spread_rotation", -1.0), ("fine_rays", 6),
     ("coarse_steps", 0), ("colour_scale", 0.0), ("least_weight", 1.0), ("surface_sigma", -1.0)],
)  # fmt: skip
def test_settings_that_make_no_sense_are_named(setting: str, value: object) -> None:
    with pytest.raises(InputError, match=f"{setting} is .*, expected "):
        settings_of("inerf-lm", {setting: value})
