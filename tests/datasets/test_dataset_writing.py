"""What is written is what is read."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import tiny
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import open_dataset, write_transforms
from bidnerf_core.frames import Frame, View
from bidnerf_core.geometry import SE3
from refusals import refused


@st.composite
def views(draw: st.DrawFn) -> list[View]:
    """Up to three views with any camera and pose; depth goes as far as 400 m, and depth and alpha may be missing."""
    found = []
    for number in range(draw(st.integers(1, 3))):
        width, height = draw(st.integers(1, 12)), draw(st.integers(1, 12))
        focal, off = st.floats(5, 50), st.floats(-2, 2)
        lens = draw(st.sampled_from([(), (0.1, -0.02, 0.001, 0.002), (0.1, -0.02, 0.001, 0.002, 0.003)]))
        cx, cy = width / 2 + draw(off), height / 2 + draw(off)
        camera = Intrinsics(draw(focal), draw(focal), cx, cy, width, height, lens)
        pose = SE3.exp(torch.tensor(draw(st.tuples(*[st.floats(-9, 9)] * 6)), dtype=torch.float64))
        generator = torch.Generator().manual_seed(draw(st.integers(0, 999)))
        rgb, alpha = (
            torch.rand(height, width, 3, generator=generator),
            torch.rand(height, width, generator=generator),
        )
        depth = draw(st.sampled_from([0, 5, 400])) * torch.rand(height, width, generator=generator)
        depth[0, 0] = 0
        covered = alpha[..., None] * rgb + (1 - alpha[..., None]) * torch.tensor(tiny.BACKGROUND)
        seen = draw(st.booleans())
        frame = Frame(f"v {number}", covered if seen else rgb, camera, draw(st.sampled_from([None, depth])))
        found.append(View(replace(frame, alpha=alpha if seen else None), pose))
    return found


@settings(max_examples=40)
@given(seen=views(), unseen=st.just([]) | views())
def test_views_come_back(seen: list[View], unseen: list[View], tmp_path: Path) -> None:
    shutil.rmtree(tmp_path / "new", ignore_errors=True)
    write_transforms(f"{tmp_path}/new/folder", {"train": seen, "test": unseen}, tiny.BACKGROUND)
    dataset = open_dataset(tmp_path / "new/folder", tiny.BACKGROUND)
    assert dataset.splits == (("train", "test") if unseen else ("train",))
    for split, expected in (("train", seen), ("test", unseen)):
        for view, found in zip(expected, dataset.views(split) if expected else [], strict=True):
            assert found.frame.name == view.frame.name
            assert found.frame.intrinsics == view.frame.intrinsics
            torch.testing.assert_close(found.T_ref_camera.matrix(), view.T_ref_camera.matrix(), atol=1e-12, rtol=0)
            far = 0 if view.frame.depth is None else float(view.frame.depth.max())
            for what, bar in (
                ("rgb", 1.01 / 255),
                ("alpha", 0.51 / 255),
                ("depth", max(0.00051, far / 65535)),
            ):
                here, there = getattr(found.frame, what), getattr(view.frame, what)
                assert (here is None) == (there is None)
                assert here is None or float((here - there).abs().max()) < bar, what
            if view.frame.depth is not None:
                assert float(found.frame.depth[0, 0]) == 0


def test_what_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (view,) = tiny.views(1)
    with refused(where=tmp_path, found="split 'all'", expected="train, val, test"):
        write_transforms(tmp_path, {"all": [view]})
    with refused(where=tmp_path, found="two frames of split 'test' have the same name"):
        write_transforms(tmp_path, {"test": [view, view]})
    fisheye = replace(view.frame, intrinsics=replace(tiny.CAMERA, distortion=(0.0,) * 8))
    with refused(where=f"frame {view.frame.name}", found="8 coefficients", expected="at most 5"):
        write_transforms(tmp_path, {"test": [View(fisheye, SE3.identity())]})
