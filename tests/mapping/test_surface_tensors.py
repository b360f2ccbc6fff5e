"""A surface as named tensors: there and back, and what is not one is refused."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import baked
from bidnerf_core.mapping import surface_from_tensors, surface_tensors


def test_there_and_back() -> None:
    surface = baked.toy()
    again = surface_from_tensors(surface_tensors(surface))
    assert again.grid == surface.grid
    for name, value in surface_tensors(surface).items():
        found = surface_tensors(again)[name]
        assert found.dtype == value.dtype
        assert torch.equal(found, value)


def test_an_uneven_corner_comes_back_exactly() -> None:
    from dataclasses import replace

    toy = baked.toy()
    grid = replace(toy.grid, lower=(0.1, 1 / 3, -1e-7), cell=1 / 7)
    odd = replace(toy, index=replace(toy.index, grid=grid))
    again = surface_from_tensors(surface_tensors(odd))
    assert again.grid == odd.grid


def nan(value: Tensor) -> Tensor:
    return torch.full_like(value, torch.nan)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("positions", nan, "positions holds NaN"),
        ("positions", lambda v: 1e30 * v, "positions is"),
        ("rgb", lambda v: v + 1e30, "rgb is"),
        ("rgb", lambda v: v - 2, "rgb is"),
        ("rgb_gradient", lambda v: v + 1e30, "rgb_gradient is"),
        ("normals", lambda v: 1e30 * v, "unit length"),
        ("normals", torch.zeros_like, "unit length"),
        ("cell", nan, "cell holds NaN"),
        ("cell", torch.zeros_like, "cell is 0"),
        ("rgb", lambda v: v[1:], "as many normals"),
        ("normals", lambda v: v[:, :2], "normals is"),
        ("entries", lambda v: v + 1000, "expected 0 to"),
        ("entries", lambda v: v - 1, "expected 0 to"),
        ("entries", lambda v: v[:0], "entries"),
        ("entries", lambda v: v[:-1], "do not exist"),
        ("entries", lambda v: v.long(), "int64"),
        ("first", lambda v: v - 1, "do not exist"),
        ("first", lambda v: v[1:], "shape of the blocks"),
        ("level", lambda v: v + 4, "level has a maximum of"),
        ("shape", lambda v: v + 8, "shape of the blocks"),
        ("shape", lambda v: 0 * v, "numbers of cells"),
        ("shape", lambda v: v * 10**6, "numbers of cells|larger cells"),
        ("keyframes", lambda v: v.float(), "keyframes is torch.float32"),
        ("keyframes", lambda v: v[:0], "keyframes are missing"),
        ("keyframes", lambda v: 2 * v, "not a rigid"),
    ],
)
def test_what_is_no_surface_is_refused(name: str, change, said: str) -> None:
    tensors = surface_tensors(baked.toy())
    with pytest.raises(ValueError, match=said):
        surface_from_tensors(tensors | {name: change(tensors[name])})


@pytest.mark.parametrize("name", ["positions", "entries", "lower"])
def test_a_missing_tensor_is_named(name: str) -> None:
    tensors = surface_tensors(baked.toy())
    del tensors[name]
    with pytest.raises(KeyError, match=name):
        surface_from_tensors(tensors)
