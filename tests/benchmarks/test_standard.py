"""The standard benchmarks read the folders that their authors publish, with each ground truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from bidnerf import SE3, Intrinsics, View
from bidnerf.results import as_picture
from bidnerf.scenes import demo_object, orbit, views
from bidnerf_core.errors import InputError

Script = Callable[[str], ModuleType]
CAMERA, SFM_FOCAL = Intrinsics(32.0, 32.0, 16.0, 12.0, 32, 24), 33.0


def seen(count: int, seed: int = 0) -> list[View]:
    return views(demo_object(), CAMERA, orbit(3.5, count, seed=seed))


@pytest.fixture
def standard(script: Script) -> ModuleType:
    return script("standard")


def write_frame(folder: Path, number: int, view: View, suffix: str) -> None:
    """Write a frame in the format that 7-Scenes and 12-Scenes share."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = folder / f"frame-{number:06}"
    assert view.frame.depth is not None
    iio.imwrite(f"{stem}.color.{suffix}", as_picture(view.frame.rgb))
    iio.imwrite(f"{stem}.depth.png", (1000 * view.frame.depth).numpy().astype(np.uint16))
    np.savetxt(f"{stem}.pose.txt", view.T_ref_camera.matrix().numpy())


def quaternion(T: SE3) -> str:
    return " ".join(f"{x:.9f}" for x in T.quaternion("wxyz").tolist())


def published(folder: Path, layout: str, train: list[View], test: list[View]) -> Path:
    """Write a scene as the authors of a benchmark do, with the poses of structure from motion beside it."""
    scene, sfm, rows = folder / "apt1" / "kitchen", folder / "sfm", dict[str, list[str]]()
    if layout == "Cambridge":
        cameras = []
        for split, some in (("train", train), ("test", test)):
            listed = ["Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", ""]
            for number, view in enumerate(some):
                name, T = f"seq_{split}/frame{number:05}", view.T_ref_camera.to(dtype=torch.float64)
                (scene / name).parent.mkdir(parents=True, exist_ok=True)
                iio.imwrite(scene / f"{name}.png", as_picture(view.frame.rgb))
                centre = " ".join(map(str, T.translation.tolist()))
                listed.append(f"{name}.png {centre} {quaternion(T.inverse())}")
                cameras.append(f"{name}.jpg\t{CAMERA.fx} {quaternion(T.inverse())} {centre} 0.01 0")
            (scene / f"dataset_{split}.txt").write_text("\n".join(listed))
        (scene / "reconstruction.nvm").write_text("\n".join(["NVM_V3", "", f"{len(cameras)}", *cameras]))
        return scene
    numbered = [*(("test", view) for view in test), *(("train", view) for view in train)]
    for number, (split, view) in enumerate(numbered):
        seven = layout == "7-Scenes"
        place = f"seq-0{1 + (split == 'train')}" if seven else "data"
        write_frame(scene / place, number, view, suffix := "png" if seven else "jpg")
        T = view.T_ref_camera.to(dtype=torch.float64).inverse()
        moved = " ".join(str(x) for x in T.translation.tolist())
        image = f"{place}/frame-{number:06}.color.{suffix}"
        rows.setdefault(split, []).append(f"{image} {quaternion(T)} {moved} {SFM_FOCAL}")
    if layout == "7-Scenes":
        (scene / "TestSplit.txt").write_text("sequence1\n")
        (scene / "TrainSplit.txt").write_text("sequence2\n")
    else:
        c = CAMERA
        matrix = f"{c.fx} 0 {c.cx - 0.5} 0 0 {c.fy} {c.cy - 0.5} 0 0 0 1 0 0 0 0 1"
        lines = [f"m_{kind}Width = {c.width}\nm_{kind}Height = {c.height}" for kind in ("color", "depth")]
        lines += [f"m_calibration{kind}Intrinsic = {matrix}" for kind in ("Color", "Depth")]
        (scene / "info.txt").write_text("\n".join(lines))
        (scene / "split.txt").write_text(f"sequence0 [frames={len(test)}] [start=0 ; end={len(test) - 1}]\n")
    benchmark = layout.lower().replace("-", "")
    name = "kitchen" if layout == "7-Scenes" else "apt1_kitchen"
    (sfm / benchmark).mkdir(parents=True)
    for split, some in rows.items():
        (sfm / benchmark / f"{name}_{split}.txt").write_text("\n".join(some))
    return scene


@pytest.mark.parametrize("layout", ["7-Scenes", "12-Scenes", "Cambridge"])
def test_a_scene_is_read_as_published(standard: ModuleType, tmp_path: Path, layout: str) -> None:
    train, test = seen(4), seen(2, seed=1)
    folder = published(tmp_path, layout, train, test)
    assert standard.benchmark_of(folder) == layout
    found = standard.ground_truths(folder, tmp_path / "sfm")
    assert list(found) == (["sfm"] if layout == "Cambridge" else ["dslam", "sfm"])
    for split, some in (("train", train), ("test", test)):
        read = found["sfm"].views(split)
        assert len(read) == len(some)
        for one, true in zip(read, some, strict=True):
            torch.testing.assert_close(
                one.T_ref_camera.matrix(),
                true.T_ref_camera.to(dtype=torch.float64).matrix(),
                atol=1e-6,
                rtol=0,
            )
            assert one.frame.intrinsics.fx == (CAMERA.fx if layout == "Cambridge" else SFM_FOCAL)
            assert one.frame.has_depth == (layout != "Cambridge")


def test_another_folder_is_refused(standard: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no dataset_train"):
        standard.benchmark_of(tmp_path)


def test_medians_and_shares_count_every_query_and_coverage_the_accepted(standard: ModuleType) -> None:
    def row(translation: float | None, converged: bool, squared: float | None = 1.0) -> dict[str, Any]:
        return {
            "translation": translation,
            "rotation_deg": translation,
            "converged": converged,
            "normalized_error_squared": squared,
            "cpu_seconds": 1.0,
        }

    rows = [row(0.01, True), row(0.03, True, 20.0), row(0.4, True, None), row(0.04, False), row(None, False)]
    found = standard.summary(rows, (0.05, 5.0))
    assert json.loads(json.dumps(found)) == found
    assert found["median_translation"] == 0.04
    assert (found["5 cm, 5 deg"], found["2 cm, 2 deg"]) == (0.6, 0.2)
    assert (found["accepted"], found["wrong_of_accepted"], found["inside_95_of_accepted"]) == (3, 1, 1)
    assert standard.summary(rows, (0.5, 5.0))["wrong_of_accepted"] == 0
    assert standard.summary([row(None, False)], (0.05, 5.0))["median_translation"] is None


@pytest.mark.slow
def test_a_scene_is_trained_asked_and_recorded(
    standard: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = published(tmp_path, "12-Scenes", seen(8), seen(2, seed=1))
    monkeypatch.setattr(standard, "RESULTS", tmp_path)
    monkeypatch.setattr(standard, "record", lambda name, results: (tmp_path / name).write_text(json.dumps(results)))
    monkeypatch.setattr("sys.argv", ["standard.py", str(folder), "--maps", str(tmp_path / "maps"), "--steps", "5"])
    standard.main()
    found = json.loads((tmp_path / "standard").read_text())
    assert {name: list(modes) for name, modes in found.items()} == {"kitchen, dslam": ["RGB", "RGB-D"]}
    assert found["kitchen, dslam"]["RGB"]["n"] == 2
    assert "within" not in capsys.readouterr().err
