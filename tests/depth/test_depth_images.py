"""Depth images: units, and values that stand for "nothing measured"."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from bidnerf_core.depth import DepthReader, depth_image, read_depth_image
from bidnerf_core.errors import InputWarning
from refusals import refused

LARGEST_FLOAT = float(np.finfo(np.float32).max)


@pytest.mark.parametrize(
    ("value", "name"),
    [
        (np.nan, "NaN"),
        (np.inf, "infinite"),
        (-np.inf, "infinite"),
        (-1.0, "negative"),
        (LARGEST_FLOAT, "1e+10 or more"),
        (1e10, "1e+10 or more"),
        (2e9, "over 1e+09 m"),
        (65535.0, "65535"),
        (65.535, "65.535"),
    ],
)
@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_floats_that_stand_for_nothing(value: float, name: str, kind: str) -> None:
    found = depth_image(np.array([[1.5, 2.5], [value, 0.0]], dtype=kind), 1.0, "depth")
    assert found.metres.tolist() == [[1.5, 2.5], [0, 0]]
    assert found.replaced == {name: 1}
    assert found.notice(unit_assumed=False) == f"treated as not measured: 1 x {name}"
    blender = np.array([[1500, 1e10]], dtype=kind)
    assert depth_image(blender, 0.001, "depth").metres.tolist() == [[1.5, 0]]  # in any unit


@pytest.mark.parametrize("kind", ["uint16", "int32", "int64", "uint8"])
def test_the_largest_integer_stands_for_nothing(kind: str) -> None:
    largest = np.iinfo(kind).max
    found = depth_image(np.array([[0, 1, 100, largest]], dtype=kind), 0.01, "depth")
    torch.testing.assert_close(found.metres, torch.tensor([[0, 0.01, 1.0, 0]]))
    assert found.replaced == {str(largest): 1}


@pytest.mark.parametrize(("kind", "unit"), [("uint16", 0.001), ("int32", 0.001), ("float32", 1.0)])
def test_a_missing_unit_is_assumed_with_a_notice(kind: str, unit: float) -> None:
    found = depth_image(np.array([[0, 1000, 2000, 3000]], dtype=kind), None, "depth")
    assert found.unit == unit
    assert found.median == pytest.approx(2000 * unit)
    expected = f"depth_unit is not given, {unit:g} m per step is assumed: median depth {2000 * unit:g} m"
    assert found.notice(unit_assumed=True) == expected
    assert found.notice(unit_assumed=False) is None


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("unit", [0.0, -1.0, np.nan, np.inf, "mm"])
def test_units_that_are_none(unit: Any) -> None:
    with refused(where="depth", found=f"depth_unit is {unit!r}", expected="a positive number of metres"):
        depth_image(np.ones((2, 2)), unit, "depth")


@pytest.mark.parametrize("raw", [np.ones((2, 2, 3)), np.ones(3), np.ones((2, 2), bool), np.ones((2, 2), "U1")])
def test_arrays_that_are_no_depth(raw: np.ndarray) -> None:
    with refused(found="depth is", expected="one channel of integer or floating-point numbers"):
        depth_image(raw, 1.0, "depth")


def test_files_of_every_kind_agree(tmp_path: Path) -> None:
    steps = np.random.default_rng(0).integers(0, 5000, (6, 8)).astype(np.uint16)
    Image.fromarray(steps).save(tmp_path / "a.png")
    Image.fromarray(steps.astype(np.float32)).save(tmp_path / "a.tif")
    np.save(tmp_path / "a.npy", steps)
    expected = torch.from_numpy(steps.astype(np.float32) * 0.001)
    for name in ("a.png", "a.tif", "a.npy"):
        torch.testing.assert_close(read_depth_image(tmp_path / name, 0.001).metres, expected)
    torch.testing.assert_close(
        depth_image(torch.from_numpy(steps), 0.001, "depth").metres, expected
    )  # also as torch's uint16


def filled(limit: float, kind: str = "uint16", share: float = 0.3) -> np.ndarray:
    """Depth from 500 to 3499 steps, with ``limit`` in a share of the pixels."""
    raw = np.random.default_rng(1).integers(500, 3500, (40, 50)).astype(kind)
    raw.flat[: round(share * raw.size)] = limit
    return raw


@pytest.mark.parametrize("limit", [4000, 10000, 10500, 4095, 8191, 16383, 32767])
@pytest.mark.parametrize("share", [0.05, 0.6])
def test_a_sensors_limit_counts_as_not_measured(limit: int, share: float) -> None:
    raw = filled(limit, share=share)
    found = depth_image(raw, 0.001, "depth")
    assert found.replaced == {f"{limit} (the sensor's limit)": round(share * raw.size)}
    torch.testing.assert_close(found.metres, torch.from_numpy(np.where(raw == limit, 0, raw * 0.001)).float())


def test_a_far_plane_in_floats_counts_as_not_measured() -> None:
    raw = filled(20000, "float32") / 1000
    assert depth_image(raw, 1.0, "depth").replaced == {"20 (the sensor's limit)": 600}


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (filled(4237), "no round number"),
        (filled(3500), "nearer than any sensor's limit"),
        (filled(10000, share=0.04), "few pixels"),
        (np.full((40, 50), 10000, np.uint16), "a wall and nothing else"),
        (
            np.repeat([1000, 4000], [1200, 800]).reshape(40, 50).astype(np.uint16),
            "two walls that face the camera",
        ),
        (np.arange(2000).reshape(40, 50).astype(np.uint16) * 5, "a largest value that occurs once"),
    ],
)
def test_a_largest_depth_that_is_measured(raw: np.ndarray, why: str) -> None:
    assert depth_image(raw, 0.001, "depth").replaced == {}, why


def test_a_recording_mentions_each_kind_of_value_once(tmp_path: Path) -> None:
    images = [np.array([[1.0, value]]) for value in (1.0, np.nan, np.nan, 1e10, 65.535)]
    for number, image in enumerate(images):
        np.save(tmp_path / f"{number}.npy", image)
    read = DepthReader(documented=["65.535"])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for number in range(5):
            assert read(tmp_path / f"{number}.npy", 1.0).metres[0, 0] == 1
    assert [str(warning.message).partition(": ")[2] for warning in caught] == [
        "depth: treated as not measured: 1 x NaN, here and in the images that follow",
        "depth: treated as not measured: 1 x 1e+10 or more, here and in the images that follow",
    ]
    assert all(warning.category is InputWarning for warning in caught)
