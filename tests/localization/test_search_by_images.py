"""The search by images: the pose of an image without depth, from hypotheses anywhere."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Generator

import baked
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3
from bidnerf_core.localization import SurfaceRenderer
from bidnerf_core.localization.search.by_images import APART, IMAGE_STAGES, TURNED, ImageSearch, ImageStage
from bidnerf_core.localization.search.halving import Distinct
from bidnerf_core.localization.search.starts import Surroundings, hypotheses_for_images
from bidnerf_core.results import pose_error
from bidnerf_core.scenes import Box, blotches

KEYFRAMES = SE3.from_matrix(baked.toy().keyframes)


def image_search(*views: View) -> ImageSearch:
    return ImageSearch.on_surface(baked.problem(*views).without_depth(), baked.toy())


def hypotheses(search: ImageSearch, start: SE3 | None, count: int, generator: Generator) -> SE3:
    known = Surroundings(KEYFRAMES, search.extent, torch.zeros(3), search.middle)
    return hypotheses_for_images(known, start, count, generator)


@pytest.mark.parametrize("number", range(2))
def test_the_pose_is_found_without_depth(number: int, generator: Generator) -> None:
    view = baked.unseen()[number]
    search = image_search(view)
    found = search(hypotheses(search, None, 64, generator), IMAGE_STAGES[:4])
    error = pose_error(found.T[0], view.T_ref_camera)
    # Of 3.5 m and with pixels and surfels that are 4 cm wide: what is left is the field's to take.
    assert float(error.translation) < 0.2
    assert float(error.rotation_deg) < 3


def test_a_rig_is_placed_by_its_last_camera(generator: Generator) -> None:
    views = baked.unseen()[:2]
    search = image_search(*views)
    found = search(hypotheses(search, None, 32, generator), IMAGE_STAGES[:3])
    assert float(pose_error(found.T[0], views[-1].T_ref_camera).rotation_deg) < 3


def test_the_path_leads_from_a_hypothesis_to_the_answer(generator: Generator) -> None:
    search = image_search(baked.unseen()[0])
    start = hypotheses(search, None, 24, generator)
    stages = (ImageStage(12, 0, 6), ImageStage(12, 3, 3), ImageStage(16, 2, 2))
    found = search(start, stages)
    assert len(found.path.translation) == 6
    assert len(found.losses) == 5
    assert (start.matrix() == found.path[0].matrix()).all(-1).all(-1).any()
    assert torch.equal(found.path[-1].matrix(), found.T[0].matrix())
    assert found.scores.tolist() == sorted(found.scores.tolist())


def test_the_same_seed_gives_the_same_answer() -> None:
    search = image_search(baked.unseen()[1])
    stages = (ImageStage(12, 0, 4), ImageStage(12, 3, 2))
    one, same, other = (
        search(hypotheses(search, None, 24, Generator().manual_seed(seed)), stages) for seed in (3, 3, 4)
    )
    assert torch.equal(one.T.matrix(), same.T.matrix())
    assert not torch.equal(one.T.matrix(), other.T.matrix())


def test_what_looks_the_same_from_two_sides_has_no_margin(generator: Generator) -> None:
    """A box that half a turn maps onto itself."""
    paint = blotches((0.9, 0.2, 0.1), (0.1, 0.3, 0.8), 0.5, 1)

    def both(points: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
        turn = torch.tensor([-1.0, -1.0, 1.0])
        return (paint(points, normals) + paint(points * turn, normals * turn)) / 2

    scene = replace(baked.one_solid(Box((0.6, 0.4, 0.3)), both), contrast=0.0)
    surface, (view,) = baked.baked(scene), baked.images(scene, 1, seed=5)
    search = ImageSearch.on_surface(baked.problem(view, surface=surface), surface)
    half = SE3(
        torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64)), torch.zeros(3, dtype=torch.float64)
    )
    T = view.T_ref_camera
    found = search(SE3.stack([T, half @ T, T.retract(torch.full((6,), 0.05).double())]), IMAGE_STAGES[1:4])
    assert found.margin < 0.15 * float(found.scores[0])
    assert bool(Distinct(search.middle, APART * search.extent, TURNED)(found.T)[1])
    alone = search(T[None], IMAGE_STAGES[1:2])
    assert math.isinf(alone.margin)


def test_hypotheses_are_keyframes_and_what_is_about_them(generator: Generator) -> None:
    search, start = image_search(baked.unseen()[0]), baked.unseen()[0].T_ref_camera
    many = hypotheses(search, start, 64, generator)
    assert many.translation.shape == (64, 3)
    assert bool(many.is_rigid().all())
    assert torch.equal(many[0].matrix(), start.matrix())
    as_they_are = (many.matrix()[:, None] == KEYFRAMES.matrix()).flatten(2).all(-1).any(-1)
    assert int(as_they_are.sum()) == 24  # all there are
    near = pose_error(hypotheses(search, start, 1600, generator)[:400], start)
    assert 10 < float(near.rotation_deg.median()) < 40


def test_a_background_is_told_from_holes() -> None:
    """Keyframes look past the toy, so that it stands before a background, as bright as the map."""
    search = image_search(baked.unseen()[0])
    assert isinstance(search.renderer, SurfaceRenderer)
    assert search.renderer.background == baked.BOUNDS.background
    assert float(search.middle[2]) == pytest.approx(3.2, abs=0.5)  # cameras look at the toy from 3.5
