"""The search by points leads from anywhere to the pose, and measures the margin over other poses."""

from __future__ import annotations

import math

import torch
from torch import Generator

import baked
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.search.by_points import POINT_STAGES
from bidnerf_core.localization.search.starts import hypotheses_for_points, random_rotations
from bidnerf_core.results import pose_error
from bidnerf_core.scenes import Box, blotches


def test_the_pose_is_found_from_random_orientations(generator: Generator) -> None:
    for view in baked.unseen()[:2]:
        search = baked.point_search(view)
        known, rotations = search.surroundings, random_rotations(256, generator)
        placed = known.scene_middle.double() - (rotations @ known.seen_middle.double()[:, None])[..., 0]
        found = search.from_poses(SE3(rotations, placed))
        error = pose_error(found.T[0], view.T_ref_camera)
        assert float(error.translation) < 0.05
        assert float(error.rotation_deg) < 1
        assert found.margin > 0.15


def test_the_path_leads_from_a_hypothesis_to_the_answer(generator: Generator) -> None:
    search = baked.point_search(baked.unseen()[0])
    start = hypotheses_for_points(search.surroundings, None, 64, generator)
    found = search.from_poses(start)
    assert len(found.path.translation) == 1 + sum(stage.steps for stage in POINT_STAGES)
    assert (start.matrix() == found.path[0].matrix()).all(-1).all(-1).any()
    assert torch.equal(found.path[-1].matrix(), found.T[0].matrix())
    assert len(found.losses) == len(found.path.translation) - 1
    assert torch.equal(found.scores, search.score(found.T))


def test_from_the_truth_it_stays_there(generator: Generator) -> None:
    view = baked.unseen()[1]
    found = baked.point_search(view).from_poses(view.T_ref_camera[None])
    assert float(pose_error(found.T[0], view.T_ref_camera).translation) < 0.03
    assert math.isinf(found.margin)  # there was no other


def test_what_looks_the_same_from_two_sides_has_no_margin(generator: Generator) -> None:
    """A box that half a turn maps onto itself."""
    paint = blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1)

    def even(points: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
        turn = torch.tensor([-1.0, -1.0, 1.0])
        return (paint(points, normals) + paint(points * turn, normals * turn)) / 2

    scene = baked.one_solid(Box((0.6, 0.4, 0.3)), even)
    flat = type(scene)(scene.primitives, scene.bounds, scene.name, contrast=0.0)
    surface, (view,) = baked.baked(flat), baked.images(flat, 1, seed=5)
    found = baked.point_search(view, surface=surface)(None, 256, generator)
    assert found.margin < 0.1
    assert float(found.scores[0]) < 0.4
