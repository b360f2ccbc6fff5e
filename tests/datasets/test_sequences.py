"""Sequences: the order of time, every frame once, lazily, whatever the dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

import tiny
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import (
    Capture,
    open_dataset,
    open_sequence,
    write_transforms,
)
from optional import require
from refusals import refused
from scan_layouts import edit_frame, edit_keys, small_views, write_nerfstudio

NAMES = ("b_10", "b_2", "a_3", "b_1")


VIEWS = [replace(view, frame=replace(view.frame, name=n)) for view, n in zip(small_views(4), NAMES, strict=True)]


def write_file(folder: Path, extra: Sequence[dict[str, Any]], **lists: list[str]) -> Path:
    """Write ``transforms.json`` of four images, with further entries for each frame."""
    file = write_nerfstudio(folder, VIEWS) / "transforms.json"
    for number, more in enumerate(extra):
        edit_frame(file, number, **more)
    edit_keys(file, **lists)
    return folder


def names(sequence: Capture) -> list[str]:
    return [timed.frame.name for timed in sequence]


@pytest.mark.parametrize("key", ["time", "timestamp"])
def test_frames_are_in_the_order_of_their_times(key: str, tmp_path: Path) -> None:
    sequence = open_sequence(write_file(tmp_path, [{key: time} for time in (3.5, -1, 2.0, 0)]))
    assert names(sequence) == ["b_2", "b_1", "a_3", "b_10"]
    assert [timed.time for timed in sequence] == [-1, 0, 2, 3.5]
    for timed in sequence:  # pose and image belong together
        (view,) = [view for view in VIEWS if view.frame.name == timed.frame.name]
        torch.testing.assert_close(timed.frame.rgb, view.frame.rgb)
        torch.testing.assert_close(require(timed.truth).matrix(), view.T_ref_camera.matrix())


def test_the_source_of_a_frame_may_be_its_time(tmp_path: Path) -> None:
    stamps = ("1305031103.25", "1305031102.175304", "1305031102.311267", "1305031102.1")
    sequence = open_sequence(write_file(tmp_path, [{"source": f"rgb/{stamp}.png"} for stamp in stamps]))
    assert names(sequence) == ["b_1", "b_2", "a_3", "b_10"]
    assert [timed.time for timed in sequence] == sorted(map(float, stamps))


@pytest.mark.parametrize(
    "extra", [[{}] * 4, [{"time": 1}, {}, {"time": 0}, {"time": 2}], [{"source": "IMG_12.png"}] * 4]
)
def test_without_times_the_order_is_that_of_names(extra: list[dict[str, Any]], tmp_path: Path) -> None:
    sequence = open_sequence(write_file(tmp_path, extra))
    assert names(sequence) == ["a_3", "b_1", "b_2", "b_10"]
    assert [timed.time for timed in sequence] == [None] * 4


def test_every_frame_occurs_once_though_splits_share_it(tmp_path: Path) -> None:
    """Exports of nerfstudio list the same images as val and as test."""
    lists = {
        "train_filenames": ["images/b_10.png"],
        "val_filenames": ["images/b_2.png"],
        "test_filenames": ["images/b_2.png", "./images/a_3.png"],
    }
    sequence = open_sequence(write_file(tmp_path, [{}] * 4, **lists))
    assert [(timed.frame.name, timed.split) for timed in sequence] == [
        ("a_3", "test"),
        ("b_2", "val"),
        ("b_10", "train"),
    ]


def test_names_that_splits_share_are_told_apart(tmp_path: Path) -> None:
    write_transforms(tmp_path, {"train": tiny.views(2), "test": tiny.views(1)})
    found = names(open_sequence(tmp_path))
    assert len(set(found)) == 3
    assert open_dataset(tmp_path).frame_names("test")[0] in {name.removeprefix("test_") for name in found}


def test_sequences_are_indexed_and_reversed_without_reading(tmp_path: Path) -> None:
    sequence = open_sequence(write_file(tmp_path, [{"time": n} for n in range(4)]))
    (tmp_path / "images/b_2.png").unlink()
    assert sequence.names == list(NAMES)
    assert [shot.time for shot in sequence.shots] == [0, 1, 2, 3]
    assert names(sequence[::2]) == ["b_10", "a_3"]
    assert names(sequence[::-1][:2]) == ["b_1", "a_3"]
    assert sequence[-1].frame.name == "b_1"
    with refused(where=tmp_path / "images/b_2.png", found="no such file"):
        sequence[1]
    with pytest.raises(IndexError):
        sequence[4]


def test_a_folder_of_images(tmp_path: Path) -> None:
    for stem, value in (("10", 1), ("9", 0)):
        iio.imwrite(tmp_path / f"{stem}.png", np.full((6, 8, 3), value, np.uint8))
    iio.imwrite(tmp_path / "9.depth.png", np.full((6, 8), 1500, np.uint16))
    frames = list(open_sequence(tmp_path, hfov=90))
    assert [timed.frame.name for timed in frames] == ["9", "10"]
    assert [timed.time for timed in frames] == [None, None]
    assert frames[0].frame.intrinsics == Intrinsics(4, 4, 4, 3, 8, 6).from_hfov(90, 8, 6)
    assert float(require(frames[0].frame.depth).mean()) == pytest.approx(1.5)
    assert frames[1].frame.depth is None
    with refused(where=tmp_path / "9.png", found="no focal length in EXIF", expected="a camera"):
        list(open_sequence(tmp_path))
    assumed = next(iter(open_sequence(tmp_path, assumed=[Intrinsics.from_focal(20, 16, 12)]))).frame
    assert assumed.intrinsics == Intrinsics.from_focal(10, 8, 6)
    assert assumed.focal_is_approximate


def test_image_names_may_be_times(tmp_path: Path) -> None:
    for stem in ("12.9", "2.25", "2.125"):
        iio.imwrite(tmp_path / f"{stem}.png", np.zeros((6, 8, 3), np.uint8))
    assert [timed.time for timed in open_sequence(tmp_path, focal=8)] == [2.125, 2.25, 12.9]


@pytest.mark.data
def test_a_recorded_sequence_is_one_video(data_dir: Path) -> None:
    """Train and test together are every fourth frame of a video at 30 Hz, in which the camera does not jump."""
    sequence = open_sequence(data_dir / "tum_fr1_xyz")
    times = torch.tensor([shot.time for shot in sequence.shots if shot.time is not None], dtype=torch.float64)
    assert len(times) == len(sequence) == 199
    assert 0.1 < float(times.diff().min()) < float(times.diff().max()) < 0.3  # one frame is missing
    truths = [timed.truth for timed in sequence[:40]]
    steps = [float((b.translation - a.translation).norm()) for a, b in pairwise(truths) if a and b]
    assert len(steps) == 39
    assert max(steps) < 0.1
