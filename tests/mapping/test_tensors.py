"""Landmarks and a surface as named tensors: there and back, and what is neither is refused."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import baked
from bidnerf_core.errors import InputError
from bidnerf_core.localization import LandmarkMatcher
from bidnerf_core.mapping import (
    LandmarkMap,
    build_landmarks,
    concatenate,
    landmark_tensors,
    landmarks_from_tensors,
    nearest_centre,
    surface_from_tensors,
    surface_tensors,
)
from landmark_scene import Points, ring
from optional import require


@functools.cache
def landmarks() -> LandmarkMap:
    points = Points(count=60, noise=0.2)
    return build_landmarks(ring(points), points)


KINDS: dict[str, tuple[Callable[[Any], dict[str, Tensor]], Callable[[Mapping[str, Tensor]], Any]]] = {
    "landmarks": (landmark_tensors, landmarks_from_tensors),
    "surface": (surface_tensors, surface_from_tensors),
}


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("landmarks", landmarks),
        ("landmarks", lambda: landmarks()[torch.tensor([], dtype=torch.long)]),
        ("surface", baked.toy),
        (
            "surface",  # whose corner is no round number
            lambda: replace(
                baked.toy(),
                index=replace(baked.toy().index, grid=replace(baked.toy().grid, lower=(0.1, 1 / 3, -1e-7), cell=1 / 7)),
            ),
        ),
    ],
)
def test_there_and_back(kind: str, make: Callable[[], Any]) -> None:
    given, (tensors, back) = make(), KINDS[kind]
    once, again = tensors(given), tensors(back(tensors(given)))
    assert once.keys() == again.keys()
    for name, value in once.items():
        assert again[name].dtype == value.dtype
        assert torch.equal(again[name], value)
    if kind == "surface":
        assert back(once).grid == given.grid
    else:
        assert back(once).noise == given.noise


def nan(value: Tensor) -> Tensor:
    return torch.full_like(value, torch.nan)


BROKEN_LANDMARKS: list[tuple[str, Callable[[Tensor], Tensor], str]] = [
    ("positions", lambda v: torch.full_like(v, torch.nan), "positions holds NaN"),
    ("positions", lambda v: v[:, :2], "positions is"),
    ("positions", lambda v: v.double(), "float64"),
    ("deviations", lambda v: v[1:], "deviations is"),
    ("deviations", lambda v: -v, "deviations is"),
    ("descriptors", lambda v: v[:, :0], "descriptors is"),
    ("descriptors", lambda v: v.float(), "descriptors is torch.float32"),
    ("directions", lambda v: 2 * v, "unit length"),
    ("cones", lambda v: v + 4, "cones is"),
    ("positions", lambda v: torch.full_like(v, 3e38), "positions is 3e\\+38"),
    ("deviations", lambda v: torch.full_like(v, 3e38), "deviations is 3e\\+38"),
    ("sizes", lambda v: -1 - v, "sizes is"),
    ("views", lambda v: v - v, "views is"),
    ("noise", torch.zeros_like, "noise is 0"),
    ("usual_matches", lambda v: v - 1, "usual_matches is -1"),
    ("moving", lambda v: v + 1.5, "moving is 1.5"),
    ("calibration_scatter", lambda v: v + 1e30, "calibration_scatter is 1e\\+30"),
    ("pose_covariance", lambda v: v - torch.eye(6), "positive semidefinite"),
    ("pose_covariance", lambda v: v + torch.arange(6.0), "symmetric"),
]
BROKEN_SURFACES: list[tuple[str, Callable[[Tensor], Tensor], str]] = [
    ("positions", nan, "positions holds NaN"),
    ("positions", lambda v: 1e30 * v, "positions is"),
    ("rgb", lambda v: v + 1e30, "rgb is"),
    ("rgb", lambda v: v - 2, "rgb is"),
    ("rgb_gradient", lambda v: v + 1e30, "rgb_gradient exceeds"),
    ("normals", lambda v: 1e30 * v, "unit length"),
    ("normals", torch.zeros_like, "unit length"),
    ("cell", nan, "cell holds NaN"),
    ("cell", torch.zeros_like, "cell is 0"),
    ("rgb", lambda v: v[1:], "rgb is"),
    ("normals", lambda v: v[:, :2], "normals is"),
    ("entries", lambda v: v + 1000, "expected 0 to"),
    ("entries", lambda v: v - 1, "expected 0 to"),
    ("entries", lambda v: v[:0], "entries"),
    ("entries", lambda v: v[:-1], "do not exist"),
    ("entries", lambda v: v.long(), "int64"),
    ("first", lambda v: v - 1, "first is -1"),
    ("first", lambda v: v[1:], "level is"),
    ("level", lambda v: v + 4, "level is"),
    ("shape", lambda v: v + 8, "shape of the blocks"),
    ("shape", lambda v: 0 * v, "shape is 0"),
    ("shape", lambda v: v * 10**6, "numbers of cells|larger cells"),
    ("keyframes", lambda v: v.float(), "keyframes is torch.float32"),
    ("keyframes", lambda v: v[:0], "keyframes is"),
    ("keyframes", lambda v: 2 * v, "not a rigid"),
]


@pytest.mark.parametrize(
    ("kind", "name", "change", "said"),
    [*(("landmarks", *row) for row in BROKEN_LANDMARKS), *(("surface", *row) for row in BROKEN_SURFACES)],
)
def test_what_is_broken_is_refused(kind: str, name: str, change: Any, said: str) -> None:
    tensors, back = KINDS[kind]
    whole = tensors(landmarks() if kind == "landmarks" else baked.toy())
    with pytest.raises(ValueError, match=said):
        back(whole | {name: change(whole[name])})
    missing = {key: value for key, value in whole.items() if key != name}
    with pytest.raises(KeyError, match=name):
        back(missing)


def many_landmarks() -> LandmarkMap:
    """Return landmarks in the order of the cells of their descriptors, with random descriptors."""
    drawn = torch.randint(0, 256, (6000, 128), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    return replace(landmarks()[torch.arange(6000) % len(landmarks())], descriptors=drawn, tracks=None).indexed()


def test_cells_of_descriptors_are_made_once_and_stored() -> None:
    made = many_landmarks()
    stored = landmarks_from_tensors(landmark_tensors(made))
    found = require(stored.descriptor_cells)
    assert torch.equal(found.centres, require(made.descriptor_cells).centres)
    assert torch.equal(found.cell, nearest_centre(made.descriptors, found.centres))
    assert bool((found.cell.diff() >= 0).all())
    query = made.descriptors[::97]
    for here in (
        stored,
        replace(stored, descriptor_cells=None),
    ):  # an earlier version's: cells are made when the map is opened
        distance, number = LandmarkMatcher(here).nearest(query, 1)
        assert torch.equal(number[:, 0], torch.arange(0, 6000, 97))
        assert not distance.any()
    assert landmarks().indexed() is landmarks()


def test_cells_of_descriptors_survive_selection_and_extension() -> None:
    made = many_landmarks()
    half, rest = made[torch.arange(0, 6000, 2)], made[torch.arange(1, 6000, 2)]
    joined = concatenate([half, replace(rest, descriptor_cells=None)])
    cells = require(joined.descriptor_cells)
    assert torch.equal(cells.cell, nearest_centre(joined.descriptors, cells.centres))
    assert torch.equal(LandmarkMatcher(joined).nearest(joined.descriptors[::89], 1)[1][:, 0], torch.arange(0, 6000, 89))


@pytest.mark.parametrize(("name", "change"), [("cell", lambda v: v + 1), ("cell_centres", lambda v: v[:, :100])])
def test_cells_that_do_not_fit_the_descriptors_are_refused(name: str, change: Any) -> None:
    whole = landmark_tensors(many_landmarks())
    with pytest.raises(ValueError, match=f"{name} is"):
        landmarks_from_tensors(whole | {name: change(whole[name])})


def test_correlation_grows_with_the_square_root_of_the_matches_where_the_usual_number_is_known() -> None:
    unknown = replace(landmarks(), correlation=17.0)
    assert unknown.correlation_of(25) == unknown.correlation_of(400) == 17
    known = replace(unknown, usual_matches=400.0)
    assert [known.correlation_of(n) for n in (0, 25, 100, 400, 1600)] == [1, 5, 9, 17, 33]
    assert replace(known, correlation=1.0).correlation_of(25) == 1


@pytest.mark.parametrize("channels", [1, 7, 129, 4096])
def test_descriptors_of_another_detector_are_named_when_they_meet(channels: int) -> None:
    other = replace(landmarks(), descriptors=torch.zeros((len(landmarks()), channels), dtype=torch.uint8))
    with pytest.raises(InputError, match=f"descriptors have {channels} channels, those of the image"):
        LandmarkMatcher(other).nearest(landmarks().descriptors, 2)
