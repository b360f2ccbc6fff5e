"""Readers of phone apps and data sets: what they read is what was written, and they fulfil the contract of readers."""

from __future__ import annotations

import warnings
from itertools import pairwise
from pathlib import Path

import pytest
import torch

from bidnerf_core.datasets import (
    READERS,
    find_reader,
    open_dataset,
    open_sequence,
    phone_scans,
    read_trajectory,
)
from bidnerf_core.errors import InputWarning
from bidnerf_core.frames import View
from bidnerf_core.maps import read_views
from bidnerf_core.results import PosedImage, write_poses
from bidnerf_core.testing import ReaderContract, training_views
from scan_layouts import LAYOUTS, PERIOD

COUNT = 10
LAWS = [name for name in dir(ReaderContract) if name.startswith("test_")]


@pytest.fixture(scope="module")
def written() -> list[View]:
    return list(training_views())[:COUNT]


@pytest.fixture(scope="module", params=LAYOUTS)
def layout(
    request: pytest.FixtureRequest, written: list[View], tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path]:
    """A layout, and a capture in it."""
    _, write, _, _ = LAYOUTS[request.param]
    return request.param, write(tmp_path_factory.mktemp("capture"), written)


def test_the_contract_of_readers(layout: tuple[str, Path]) -> None:
    """Among its laws: rigid poses, axes by epipolar lines, depth in the unit of the poses, frames in order of time."""
    kind, folder = layout
    subject = type("Subject", (ReaderContract,), {"name": LAYOUTS[kind][0], "folder": folder})()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for law in LAWS:
            getattr(subject, law)()


def test_what_is_read_is_what_was_written(layout: tuple[str, Path], written: list[View]) -> None:
    kind, folder = layout
    name, _, has_depth, has_times = LAYOUTS[kind]
    assert find_reader(folder) is READERS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        frames = list(open_sequence(folder))
        dataset = open_dataset(folder)
    assert len(frames) == COUNT
    assert getattr(dataset, "unit", None) == (None if kind == "reality-capture" else "metres")
    assert sorted(dataset.splits) == ["test", "train"]
    assert sum(len(dataset.frame_names(split)) for split in dataset.splits) == COUNT
    for timed, view in zip(frames, written, strict=True):
        assert timed.truth is not None
        torch.testing.assert_close(timed.truth.matrix(), view.T_ref_camera.matrix(), atol=1e-6, rtol=0)
        found, expected = timed.frame.intrinsics, view.frame.intrinsics
        assert (found.width, found.height) == (expected.width, expected.height)
        torch.testing.assert_close(found.matrix(), expected.matrix(), atol=1e-4, rtol=0)
        rgb = timed.frame.rgb.float() / (255 if timed.frame.rgb.dtype == torch.uint8 else 1)
        assert float((rgb - view.frame.rgb).abs().mean()) < (
            0.05 if kind == "stray-scanner" else 0.03
        )  # a video has colours of half the resolution
        assert (timed.frame.depth is not None) == has_depth
        if timed.frame.depth is not None and view.frame.depth is not None:
            known = timed.frame.depth > 0
            assert float((timed.frame.depth - view.frame.depth)[known].abs().max()) < 0.002
    times = [timed.time for timed in frames]
    assert (None not in times) == has_times
    if has_times:
        gaps = [b - a for a, b in pairwise(times)]  # type: ignore[operator]
        assert gaps == pytest.approx([PERIOD] * (COUNT - 1), abs=1e-6)


@pytest.mark.parametrize("kind", ["record3d", "polycam", "stray-scanner"])
def test_photos_of_phone_apps_have_the_size_that_is_asked_for(
    kind: str, written: list[View], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their usual size is small, and a larger one is had for the asking."""
    folder = LAYOUTS[kind][1](tmp_path, written)
    monkeypatch.setattr(phone_scans, "LARGEST_SIDE", 40)
    whole = written[0].frame.intrinsics
    for asked, side in ((None, 40), (30, 30), (50, 50), (2000, max(whole.width, whole.height))):
        frames = [view.frame for view in read_views(folder, largest=asked).views]
        assert {max(frame.rgb.shape[:2]) for frame in frames} == {side}
        found, expected = frames[0].intrinsics, whole.scaled(side / max(whole.width, whole.height))
        torch.testing.assert_close(found.matrix(), expected.matrix(), atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", ["path.kitti.txt", "path.euroc.csv", "path.tum"])
def test_poses_that_are_written_are_read_again(name: str, written: list[View], tmp_path: Path) -> None:
    times = [PERIOD * number for number in range(COUNT)]
    posed = [
        PosedImage(f"{number}", number, view.frame.intrinsics, view.T_ref_camera, time=times[number])
        for number, view in enumerate(written)
    ]
    write_poses(tmp_path / name, posed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = read_trajectory(tmp_path / name, times)
    assert path.times.tolist() == pytest.approx(times)
    for number, view in enumerate(written):
        torch.testing.assert_close(
            path.translations[number], view.T_ref_camera.translation, atol=1e-9, rtol=0
        )
        torch.testing.assert_close(path.rotations[number], view.T_ref_camera.rotation, atol=1e-9, rtol=0)
    if name.endswith(".kitti.txt"):
        with pytest.warns(InputWarning, match="image 1 has no pose; KITTI rows do not state their image"):
            write_poses(tmp_path / name, [posed[0], *posed[2:]])
