"""The command line finds the examples by name: a map is trained, an image is localized in it, and a fault is tried."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from bidnerf import load_map
from bidnerf.cli import main


@pytest.fixture(scope="module")
def trained(capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "map"
    small = "--steps 8 --rays-at-most 256 --levels 3 --log2-table-size 9 --finest-resolution 16 --coarse-levels 1"
    words = [*small.split(" "), "--landmark-features", "orb", "--refine-poses", "never"]
    assert main(["train", str(capture), "--out", str(folder), *words]) == 0
    return folder


def test_the_map_is_of_the_readers_images_and_the_detectors_landmarks(trained: Path) -> None:
    scene = load_map(trained)
    assert scene.info.landmark_features == "orb"
    assert scene.landmarks.descriptors.shape[1] == 256
    assert [camera.name for camera in scene.info.cameras][:2] == ["image00", "image01"]


def test_an_image_is_localized_by_the_method(trained: Path, capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--frame", "image03", "--method", "landmarks-alone", "--json"]
    assert main(["localize", str(trained), str(capture), "--split", "train", *words]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["method"] == "landmarks-alone"
    assert found["converged"]
    assert found["error"]["translation"] < 0.02


def test_a_fault_is_evaluated(trained: Path, capture: Path, tmp_path: Path) -> None:
    words = ["--split", "train", "--protocol", "none", "--method", "landmarks-alone", "--trials", "1"]
    out = tmp_path / "results.jsonl"
    faults = ["--fault", "none", "--fault", "stripes:0.3", "--workers", "1"]
    assert main(["evaluate", str(trained), str(capture), *words, *faults, "--out", str(out)]) == 0
    tried = [json.loads(line)["trial"]["fault"] for line in out.read_text().splitlines()]
    assert sorted(tried) == ["none", "stripes:0.3"]


def test_all_of_them_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plugins", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    mine = {(row["group"], row["name"]) for row in listed if row["distribution"] == "bidnerf-examples"}
    assert mine == {
        ("readers", "pose-table"),
        ("methods", "landmarks-alone"),
        ("features", "orb"),
        ("faults", "stripes"),
    }
