"""What is written is what is read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

import tiny
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import open_dataset, write_transforms
from bidnerf_core.errors import InputError
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3


def test_views_come_back(tmp_path: Path) -> None:
    seen, unseen = tiny.views(3), tiny.views(2, seed=1)
    write_transforms(tmp_path, {"train": seen, "test": unseen}, tiny.BACKGROUND)
    dataset = open_dataset(tmp_path, tiny.BACKGROUND)
    assert set(dataset.splits) == {"train", "test"}
    for split, views in (("train", seen), ("test", unseen)):
        for expected, found in zip(views, dataset.views(split), strict=True):
            assert found.frame.name == expected.frame.name
            assert found.frame.intrinsics == expected.frame.intrinsics
            assert torch.allclose(found.T_ref_camera.matrix(), expected.T_ref_camera.matrix(), atol=1e-12)
            for what, bar in (("rgb", 1.01 / 255), ("alpha", 0.51 / 255), ("depth", 0.00051)):
                difference = getattr(found.frame, what) - getattr(expected.frame, what)
                assert float(difference.abs().max()) < bar, what


def test_the_folder_is_made_and_may_be_named_by_text(tmp_path: Path) -> None:
    write_transforms(f"{tmp_path}/new/folder", {"train": tiny.views(1), "test": []})
    dataset = open_dataset(tmp_path / "new" / "folder")
    assert [(split, len(dataset.frame_names(split))) for split in dataset.splits] == [("train", 1)]


def test_a_lens_and_far_depth_come_back(tmp_path: Path) -> None:
    camera = Intrinsics(20.0, 21.0, 5.5, 4.5, 12, 9, (0.1, -0.02, 0.001, 0.002, 0.003))
    generator = torch.Generator().manual_seed(0)
    depth = 400 * torch.rand((9, 12), generator=generator)
    depth[0] = 0
    frame = Frame("far", torch.rand((9, 12, 3), generator=generator), camera, depth)
    write_transforms(
        tmp_path,
        {"val": [View(frame, SE3.identity()), View(replace(frame, name="b", depth=None), SE3.identity())]},
    )
    first, second = open_dataset(tmp_path).views("val")
    assert first.frame.intrinsics == camera
    assert float((first.frame.depth - depth).abs().max()) < 400 / 65535
    assert (first.frame.depth == 0).equal(depth == 0)
    assert second.frame.depth is None
    assert second.frame.alpha is None


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (view,) = tiny.views(1)
    with pytest.raises(InputError, match="split 'all'"):
        write_transforms(tmp_path, {"all": [view]})
    with pytest.raises(InputError, match="the same name"):
        write_transforms(tmp_path, {"test": [view, view]})
    fisheye = replace(view.frame, intrinsics=replace(tiny.CAMERA, distortion=(0.0,) * 8))
    with pytest.raises(InputError, match="8 coefficients"):
        write_transforms(tmp_path, {"test": [View(fisheye, SE3.identity())]})
