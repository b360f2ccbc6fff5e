"""Cells of landmarks: an image shows no landmark that they leave out, and they leave out most of what it does not show."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bidnerf_core import SE3
from bidnerf_core.localization.landmarks.correspondences import query_images
from bidnerf_core.localization.landmarks.guided import guided_matches
from bidnerf_core.mapping import LandmarkMap, build_landmarks
from bidnerf_core.mapping.landmarks import landmark_map
from bidnerf_core.mapping.landmarks.landmark_cells import MOST_IN_CELL, LandmarkCells
from landmark_scene import Points, looking_in, ring

OBLIQUE, SIZE = 0.7, 0.01


def some(count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return positions in a long house, directions in which they were seen, cones about these, and sizes."""
    generator = torch.Generator().manual_seed(seed)
    positions = torch.rand(count, 3, generator=generator) * torch.tensor([40.0, 10.0, 3.0])
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    directions[: count // 2] = torch.tensor([0.0, 0.0, 1.0])
    cones, sizes = torch.rand(2, count, generator=generator)
    return positions, directions, cones, 0.2 * sizes


def poses(count: int) -> SE3:
    generator = torch.Generator().manual_seed(1)
    turn = 2 * torch.randn(count, 3, dtype=torch.float64, generator=generator)
    place = torch.rand(count, 3, dtype=torch.float64, generator=generator) * torch.tensor([50.0, 15.0, 5.0])
    return SE3(SE3.exp(torch.cat([torch.zeros_like(turn), turn], dim=-1)).rotation, place)


def shown(
    T: SE3, slopes: Tensor, positions: Tensor, directions: Tensor, cones: Tensor, sizes: Tensor
) -> Tensor:
    """Return which landmarks an image shows, from the definition."""
    local = T.inverse().to(torch.float32).apply(positions)
    towards = torch.nn.functional.normalize(T.translation.float() - positions, dim=-1)
    angle = (towards * directions).sum(-1).clamp(-1, 1).acos()
    return (
        (local[:, :2].abs() <= slopes * local[:, 2:]).all(-1)
        & (local[:, 2] > 0)
        & (sizes >= SIZE * local[:, 2])
        & (angle <= cones + OBLIQUE)
    )


@pytest.mark.parametrize("count", [1, MOST_IN_CELL + 1, 20_000])
def test_no_landmark_in_the_image_is_left_out(count: int) -> None:
    landmarks, slopes = some(count), torch.tensor([0.7, 0.5])
    cells, looked_at = LandmarkCells.of(*landmarks), 0
    for number in range(40):
        T = poses(40)[number]
        found = cells.seen_from(T, slopes, OBLIQUE, SIZE)
        assert len(found.unique()) == len(found)
        assert not torch.isin(shown(T, slopes, *landmarks).nonzero()[:, 0], found, invert=True).any()
        looked_at += len(found)
    assert looked_at < 0.25 * 40 * count or count < 20_000  # a few cells are hardly smaller than the scene


def test_each_landmark_is_in_one_cell_which_holds_it() -> None:
    positions, *others = some(5000)
    cells = LandmarkCells.of(positions, *others)
    assert torch.equal(cells.order.sort().values, torch.arange(5000))
    assert int(cells.counts.max()) <= MOST_IN_CELL
    cell = torch.arange(len(cells.counts)).repeat_interleave(cells.counts)
    apart = (positions[cells.order] - cells.centres[cell]).norm(dim=-1)
    assert bool((apart <= cells.radii[cell] + 1e-4).all())


def test_guided_matching_finds_the_same_with_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    points, truth = Points(count=600, noise=0.3), looking_in(0.43)
    landmarks, image = build_landmarks(ring(points), points), query_images([points.view(truth)], points)

    def matches(known: LandmarkMap) -> list[list[int]]:
        found = guided_matches(image, known, truth, radius=5.0, most_distance=200.0**2)
        return sorted(torch.stack([found.keypoint, found.landmark], dim=-1).tolist())

    assert landmarks.cells is None
    plain = matches(landmarks)
    assert len(plain) > 50
    monkeypatch.setattr(landmark_map, "FEW", 10)
    assert replace(landmarks).cells is not None
    assert matches(replace(landmarks)) == plain
