"""Hypotheses are as many as were asked for, cover all orientations, and begin with the start."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import kstest
from torch import Generator

import baked
from bidnerf_core.geometry import SE3
from bidnerf_core.localization.search.starts import (
    _without_repetition,
    hypotheses_for_points,
    neighbours,
    random_rotations,
)


@pytest.mark.parametrize("started", [True, False])
@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 33, 256])
def test_they_are_as_many_as_were_asked_for(count: int, started: bool, generator: Generator) -> None:
    view = baked.unseen()[0]
    start = view.T_ref_camera if started else None
    pool = hypotheses_for_points(baked.point_search(view).surroundings, start, count, generator)
    assert pool.rotation.shape == (count, 3, 3)
    assert pool.translation.shape == (count, 3)
    assert pool.rotation.dtype == torch.float64
    assert pool.is_rigid().all()
    assert len(torch.unique(pool.translation, dim=0)) == count
    if start is not None:
        assert torch.allclose(pool[0].matrix(), start.matrix())


def test_those_about_a_start_keep_what_was_seen_about_where_it_was(generator: Generator) -> None:
    view, surface = baked.unseen()[0], baked.toy()
    known = baked.point_search(view).surroundings
    near = hypotheses_for_points(known, view.T_ref_camera, 400, generator)[:100]
    middle = known.seen_middle.double()
    off = torch.linalg.vector_norm(near.apply(middle) - view.T_ref_camera.apply(middle), dim=-1)
    assert 0.1 * surface.extent < off[1:].median() < 0.25 * surface.extent


def test_rotations_are_uniform(generator: Generator) -> None:
    """Angles have density (1 - cos) / pi, and vectors come to all directions alike (Archimedes: z is uniform)."""
    rotations = random_rotations(4000, generator)
    angles = ((rotations.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1).arccos()
    assert (
        kstest(angles.numpy(), lambda t: (t - torch.sin(torch.as_tensor(t)).numpy()) / torch.pi).pvalue > 0.01
    )
    for axis in range(3):
        assert kstest((rotations[:, 2, axis].numpy() + 1) / 2, "uniform").pvalue > 0.01
    assert random_rotations(0, generator).shape == (0, 3, 3)


def test_what_was_seen_is_put_on_the_middle_of_the_scene(generator: Generator) -> None:
    """The second half of the hypotheses: orientations, each placed so that the cloud's middle lies on the map's."""
    search = baked.point_search(baked.unseen()[0])
    poses = hypotheses_for_points(search.surroundings, None, 40, generator)[20:]
    middle = baked.toy().surfels.positions.median(0).values.double()
    assert torch.allclose(poses.apply(search.cloud.middle.double()), middle.expand(20, 3), atol=1e-6)


@pytest.mark.parametrize("count", [0, 1, 5, 12, 13])
def test_none_is_drawn_twice_before_all_are_drawn_once(count: int, generator: Generator) -> None:
    eye = torch.eye(3, dtype=torch.float64).expand(6, 3, 3)
    poses = SE3(eye, torch.arange(18, dtype=torch.float64).reshape(6, 3))
    found = _without_repetition(poses, count, generator).translation[:, 0].tolist()
    assert len(found) == count
    counts = [found.count(float(3 * i)) for i in range(6)]
    assert max(counts) - min(counts) <= 1


def test_neighbours_are_even_and_hold_the_start() -> None:
    T = baked.unseen()[0].T_ref_camera
    poses = neighbours(T, 512, 0.2, 0.1, seed=0)
    xi = (T[None].inverse() @ poses).log()
    assert float(xi[0].abs().max()) < 1e-9
    expected = torch.tensor([0.2] * 3 + [0.1] * 3, dtype=torch.float64)
    torch.testing.assert_close(xi.std(0), expected, rtol=0.1, atol=0)
    assert float(xi.mean(0).abs().max()) < 0.01
    assert neighbours(T, 1, 0.2, 0.1, seed=0).translation.shape == (1, 3)
