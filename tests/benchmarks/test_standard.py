"""The standard benchmarks read the folders that their authors publish, with each ground truth."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import torch

from bidnerf import SE3, Intrinsics, View
from bidnerf.scenes import demo_object, orbit, views
from bidnerf_core.errors import InputError
from localizations import answer_row
from scan_layouts import write_cambridge, write_frames, write_twelve_scenes

Script = Callable[[str], ModuleType]
CAMERA, SFM_FOCAL = Intrinsics(32.0, 32.0, 16.0, 12.0, 32, 24), 33.0


def render_views(count: int, seed: int = 0) -> list[View]:
    return views(demo_object(), CAMERA, orbit(3.5, count, seed=seed))


@pytest.fixture
def standard(script: Script) -> ModuleType:
    return script("standard")


def quaternion(T: SE3) -> str:
    return " ".join(f"{x:.9f}" for x in T.quaternion("wxyz").tolist())


def publish(folder: Path, layout: str, train: list[View], test: list[View]) -> Path:
    """Write a scene as the authors of a benchmark do, with the poses of structure from motion beside it."""
    scene, sfm, rows = folder / "apt1" / "kitchen", folder / "sfm", dict[str, list[str]]()
    if layout == "Cambridge":
        return write_cambridge(scene, [test[0], *train, *test[1:]])
    seven, every = layout == "7-Scenes", [*test, *train]  # the first sequence is the test split
    if seven:
        write_frames(scene / "seq-01", test, "png")
        write_frames(scene / "seq-02", train, "png")
        (scene / "TestSplit.txt").write_text("sequence1\n")
        (scene / "TrainSplit.txt").write_text("sequence2\n")
    else:
        write_twelve_scenes(scene, every)
    for number, view in enumerate(every):
        split, local = ("test", number) if number < len(test) else ("train", number - len(test))
        place = (
            f"seq-0{1 + (split == 'train')}/frame-{local:06}.color.png"
            if seven
            else f"data/frame-{number:06}.color.jpg"
        )
        T = view.T_ref_camera.to(dtype=torch.float64).inverse()
        moved = " ".join(str(x) for x in T.translation.tolist())
        rows.setdefault(split, []).append(f"{place} {quaternion(T)} {moved} {SFM_FOCAL}")
    benchmark = layout.lower().replace("-", "")
    name = "kitchen" if layout == "7-Scenes" else "apt1_kitchen"
    (sfm / benchmark).mkdir(parents=True)
    for split, some in rows.items():
        (sfm / benchmark / f"{name}_{split}.txt").write_text("\n".join(some))
    return scene


@pytest.mark.parametrize("layout", ["7-Scenes", "12-Scenes", "Cambridge"])
def test_a_scene_is_read_as_published(standard: ModuleType, tmp_path: Path, layout: str) -> None:
    train, test = render_views(7), render_views(2, seed=1)
    folder = publish(tmp_path, layout, train, test)
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
    judged = [(0.01, True), (0.03, True, 20.0), (0.4, True, None), (0.04, False), (None, False)]
    rows = [answer_row(*some) for some in judged]
    found = standard.summary(rows, (0.05, 5.0))
    assert json.loads(json.dumps(found)) == found
    assert found["median_translation"] == 0.04
    assert (found["5 cm, 5 deg"], found["2 cm, 2 deg"]) == (0.6, 0.2)
    assert (found["accepted"], found["wrong_of_accepted"], found["inside_95_of_accepted"]) == (3, 1, 1)
    assert standard.summary(rows, (0.5, 5.0))["wrong_of_accepted"] == 0
    assert standard.summary([answer_row(None, False)], (0.05, 5.0))["median_translation"] is None


@pytest.mark.slow
def test_a_scene_is_trained_asked_and_recorded(
    standard: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = publish(tmp_path, "12-Scenes", render_views(8), render_views(2, seed=1))
    monkeypatch.setattr(standard, "RESULTS", tmp_path)
    monkeypatch.setattr(standard, "record", lambda name, results: (tmp_path / name).write_text(json.dumps(results)))
    monkeypatch.setattr("sys.argv", ["standard.py", str(folder), "--maps", str(tmp_path / "maps"), "--steps", "5"])
    standard.main()
    found = json.loads((tmp_path / "standard").read_text())
    assert {name: list(modes) for name, modes in found.items()} == {"kitchen, dslam": ["RGB", "RGB-D"]}
    assert found["kitchen, dslam"]["RGB"]["n"] == 2
    assert "within" not in capsys.readouterr().err
