"""The pose of an image without depth, from hypotheses anywhere."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from bidnerf_core.localization.polish import without_depth
from bidnerf_core.localization.rgb_hypotheses import around, hypotheses
from bidnerf_core.localization.rgb_only import STAGES, surface_sight
from bidnerf_core.localization.rgb_search import Sight, Stage, different, search
from torch import Generator

import baked
from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.frames import View
from bidnerf_core.scenes.primitives import Box
from bidnerf_core.scenes.textures import blotches
from bidnerf_core.se3 import SE3

KEYFRAMES = SE3.from_matrix(baked.toy().keyframes)


def sight(*views: View) -> Sight:
    return surface_sight(without_depth(baked.problem(*views)), baked.toy())[0]


@pytest.mark.parametrize("number", range(2))
def test_the_pose_is_found_without_depth(number: int, generator: Generator) -> None:
    view = baked.unseen()[number]
    of = sight(view)
    found = search(of, hypotheses(of, KEYFRAMES, None, 64, generator), STAGES[:4])
    error = pose_error(found.T[0], view.T_ref_camera)
    # Of 3.5 m and with pixels and surfels that are 4 cm wide: what is left is the field's to take.
    assert float(error.translation) < 0.2
    assert float(error.rotation_deg) < 3


def test_a_rig_is_placed_by_its_last_camera(generator: Generator) -> None:
    views = baked.unseen()[:2]
    of = sight(*views)
    found = search(of, hypotheses(of, KEYFRAMES, None, 32, generator), STAGES[:3])
    assert float(pose_error(found.T[0], views[-1].T_ref_camera).rotation_deg) < 3


def test_the_path_leads_from_a_hypothesis_to_the_answer(generator: Generator) -> None:
    of = sight(baked.unseen()[0])
    start = hypotheses(of, KEYFRAMES, None, 24, generator)
    stages = (Stage(12, 0, 6), Stage(12, 3, 3), Stage(16, 2, 2))
    found = search(of, start, stages)
    assert len(found.path.translation) == 6
    assert len(found.losses) == 5
    assert (start.matrix() == found.path[0].matrix()).all(-1).all(-1).any()
    assert torch.equal(found.path[-1].matrix(), found.T[0].matrix())
    assert found.costs.tolist() == sorted(found.costs.tolist())


def test_the_same_seed_gives_the_same_answer() -> None:
    of = sight(baked.unseen()[1])
    stages = (Stage(12, 0, 4), Stage(12, 3, 2))
    one, same, other = (
        search(of, hypotheses(of, KEYFRAMES, None, 24, Generator().manual_seed(seed)), stages)
        for seed in (3, 3, 4)
    )
    assert torch.equal(one.T.matrix(), same.T.matrix())
    assert not torch.equal(one.T.matrix(), other.T.matrix())


def test_what_looks_the_same_from_two_sides_has_no_lead(generator: Generator) -> None:
    """A box that half a turn maps onto itself."""
    paint = blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1)

    def both(points: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
        turn = torch.tensor([-1.0, -1.0, 1.0])
        return (paint(points, normals) + paint(points * turn, normals * turn)) / 2

    scene = replace(baked.one_solid(Box((0.6, 0.4, 0.3)), both), contrast=0.0)
    surface, (view,) = baked.baked(scene), baked.images(scene, 1, seed=5)
    of, _ = surface_sight(baked.problem(view, surface=surface), surface)
    half = SE3(
        torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)
    )
    T = view.T_ref_camera
    found = search(of, SE3.stack([T, half @ T, T.retract(torch.full((6,), 0.05).double())]), STAGES[1:4])
    assert found.lead < 0.15
    assert bool(different(of, found.T)[1])
    alone = search(of, T[None], STAGES[1:2])
    assert math.isinf(alone.lead)


def test_hypotheses_are_keyframes_and_what_is_about_them(generator: Generator) -> None:
    of, start = sight(baked.unseen()[0]), baked.unseen()[0].T_ref_camera
    many = hypotheses(of, KEYFRAMES, start, 64, generator)
    assert many.translation.shape == (64, 3)
    assert bool(many.is_rigid().all())
    assert torch.equal(many[0].matrix(), start.matrix())
    as_they_are = (many.matrix()[:, None] == KEYFRAMES.matrix()).flatten(2).all(-1).any(-1)
    assert int(as_they_are.sum()) == 24  # all there are
    near = pose_error(around(of, start, 400, generator), start)
    assert 10 < float(near.rotation_deg.median()) < 40


def test_a_background_is_told_from_holes() -> None:
    of, polish = surface_sight(baked.problem(baked.unseen()[0]), baked.toy())
    assert of.sketcher.background == baked.BOUNDS.background  # type: ignore[attr-defined]
    assert not polish.exposure
    assert float(of.middle[2]) == pytest.approx(3.2, abs=0.5)  # cameras look at the toy from 3.5
