"""Interest points and regions: where they are, how they are drawn from, and images that have none."""

from __future__ import annotations

from typing import get_args

import pytest
import torch
from scipy.ndimage import binary_dilation

from bidnerf_bid import DRAWERS, DrawerName
from bidnerf_bid.pixels import interest_points, interest_regions
from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame, among

CAMERA = Intrinsics(40.0, 40.0, 32.0, 24.0, 64, 48)


def frame(rgb: torch.Tensor) -> Frame:
    return Frame("f", rgb, CAMERA)


def square() -> Frame:
    """White, with a dark square from column 20 to 39 and row 12 to 31."""
    rgb = torch.ones(48, 64, 3)
    rgb[12:32, 20:40] = 0.1
    return frame(rgb)


def blank() -> Frame:
    return frame((0.7 + torch.randn(48, 64, 3, generator=torch.Generator().manual_seed(0)) / 255).clamp(0, 1))


def test_the_corners_of_a_square_are_found() -> None:
    found = interest_points(square())
    corners = torch.tensor([[19.5, 11.5], [39.5, 11.5], [19.5, 31.5], [39.5, 31.5]])
    away = torch.cdist(found.float(), corners)
    assert bool((away.amin(0) < 2).all()), "a corner was missed"
    assert bool((away.amin(1) < 3).all()), "a point is not at a corner"


def test_regions_are_the_points_dilated() -> None:
    there = square()
    mask = torch.zeros(48, 64, dtype=torch.bool)
    columns, rows = interest_points(there).unbind(-1)
    mask[rows, columns] = True
    expected = binary_dilation(mask.numpy(), structure=torch.ones(5, 5).numpy(), iterations=3)
    found = torch.zeros(48, 64, dtype=torch.bool)
    columns, rows = interest_regions(there).unbind(-1)
    found[rows, columns] = True
    assert torch.equal(found, torch.from_numpy(expected))
    assert found.sum() > mask.sum()


@pytest.mark.parametrize("name", ["interest-points", "interest-regions"])
def test_drawn_pixels_are_among_those_found_and_all_may_be_drawn(name: DrawerName) -> None:
    there = square()
    found = interest_points(there) if name == "interest-points" else interest_regions(there)
    drawn = DRAWERS[name](there, 20 * len(found), torch.Generator().manual_seed(0))
    assert drawn.shape == (20 * len(found), 2)
    assert {tuple(p) for p in drawn.tolist()} == {tuple(p) for p in found.tolist()}


@pytest.mark.parametrize("name", get_args(DrawerName))
def test_a_blank_wall_is_drawn_from_uniformly(name: DrawerName) -> None:
    drawn = DRAWERS[name](blank(), 500, torch.Generator().manual_seed(0))
    expected = DRAWERS["uniform"](blank(), 500, torch.Generator().manual_seed(0))
    assert torch.equal(drawn, expected)


def test_a_frame_is_searched_once() -> None:
    searched = []

    def choose(f: Frame) -> torch.Tensor:
        searched.append(f)
        return interest_points(f)

    draw, first, second = among(choose), square(), blank()
    for _ in range(3):
        for f in (first, second):
            draw(f, 4, torch.Generator().manual_seed(0))
    assert searched == [first, second]


def test_a_tiny_image_is_no_fault() -> None:
    for size in (1, 2, 3):
        tiny = Frame("f", torch.rand(size, size, 3), Intrinsics(4.0, 4.0, 0.5, 0.5, size, size))
        for name in get_args(DrawerName):
            drawn = DRAWERS[name](tiny, 7, torch.Generator().manual_seed(0))
            assert drawn.shape == (7, 2)
            assert bool(((drawn >= 0) & (drawn < size)).all())
