"""The search comes from anywhere to the pose, and says how far ahead of others that is."""

from __future__ import annotations

import math

import torch
from bidnerf_core.localization.hypotheses import centred, hypotheses, random_rotations
from torch import Generator

import baked
from bidnerf_core.evaluation.errors import pose_error
from bidnerf_core.localization.search import STAGES, score, search
from bidnerf_core.scenes.primitives import Box
from bidnerf_core.scenes.textures import blotches


def test_the_pose_is_found_from_random_orientations(generator: Generator) -> None:
    surface = baked.toy()
    for view in baked.unseen()[:2]:
        cloud = baked.cloud(view)
        start = centred(random_rotations(256, generator), surface, cloud)
        found = search(surface, cloud, start)
        error = pose_error(found.T, view.T_ref_camera)
        assert float(error.translation) < 0.05
        assert float(error.rotation_deg) < 1
        assert found.lead > 0.15


def test_the_path_leads_from_a_hypothesis_to_the_answer(generator: Generator) -> None:
    surface, cloud = baked.toy(), baked.cloud(baked.unseen()[0])
    start = hypotheses(surface, cloud, None, 64, generator)
    found = search(surface, cloud, start)
    assert len(found.path.translation) == 1 + sum(stage.steps for stage in STAGES)
    assert (start.matrix() == found.path[0].matrix()).all(-1).all(-1).any()
    assert torch.equal(found.path[-1].matrix(), found.T.matrix())
    assert found.score == float(score(surface, cloud.first(2000), found.T[None]))


def test_from_the_truth_it_stays_there(generator: Generator) -> None:
    view = baked.unseen()[1]
    found = search(baked.toy(), baked.cloud(view), view.T_ref_camera[None])
    assert float(pose_error(found.T, view.T_ref_camera).translation) < 0.03
    assert math.isinf(found.lead)  # there was no other


def test_what_looks_the_same_from_two_sides_has_no_lead(generator: Generator) -> None:
    """A box that half a turn maps onto itself."""
    paint = blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1)

    def even(points: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
        turn = torch.tensor([-1.0, -1.0, 1.0])
        return (paint(points, normals) + paint(points * turn, normals * turn)) / 2

    scene = baked.one_solid(Box((0.6, 0.4, 0.3)), even)
    flat = type(scene)(scene.primitives, scene.bounds, scene.name, contrast=0.0)
    surface, (view,) = baked.baked(flat), baked.images(flat, 1, seed=5)
    cloud = baked.cloud(view)
    found = search(surface, cloud, hypotheses(surface, cloud, None, 256, generator))
    assert found.lead < 0.1
    assert found.score < 0.4
