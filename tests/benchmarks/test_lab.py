"""What benchmarks keep: rows by key that survive a kill, and records with how they were made."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from bidnerf import SE3, Intrinsics
from bidnerf_core.datasets import Capture, DepthFile, Shot
from bidnerf_core.io import FileInUse
from refusals import refused

Script = Callable[[str], ModuleType]


def test_a_script_goes_on_where_it_was_killed(script: Script, tmp_path: Path) -> None:
    store_of, path = script("_lab").RowStore, tmp_path / "rows.jsonl"
    with store_of(path) as store:
        assert [store.get(["a", n], lambda n=n: {"value": n}) for n in (1, 2)] == [{"value": 1}, {"value": 2}]
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])  # a kill in the middle of the second row
    made: list[int] = []

    def make() -> dict[str, int]:
        made.append(2)
        return {"value": 2}

    with store_of(path) as store:
        assert ["a", 1] in store
        assert ["a", 2] not in store
        assert store.get(["a", 1], make) == {"value": 1}
        assert made == []
        assert store.get(["a", 2], make) == store.get(["a", 2], make) == {"value": 2}
        with refused(where=path, found="another process", error=FileInUse), store_of(path):
            pass
    assert made == [2]
    assert path.read_bytes() == whole


@pytest.mark.parametrize("content", ["notes\n", '{"a": 1}\n', "[1]\n"])
def test_rows_of_something_else_are_left_alone(script: Script, tmp_path: Path, content: str) -> None:
    path = tmp_path / "rows.jsonl"
    path.write_text(content)
    with pytest.raises((ValueError, LookupError, TypeError)), script("_lab").RowStore(path):
        pass
    assert path.read_text() == content


def test_a_record_holds_its_results_and_how_they_were_made(script: Script, tmp_path: Path) -> None:
    path = script("_lab").record("speed", {"rate": 0.5}, seed=3, folder=tmp_path / "new")
    record = json.loads(path.read_text())
    assert (record["benchmark"], record["seed"], record["results"]) == ("speed", 3, {"rate": 0.5})
    assert record["command"].startswith("python ")
    assert {"commit", "dirty", "cpu", "date", "versions", "workers"} <= record.keys()
    with pytest.raises(ValueError, match="not JSON compliant"):
        script("_lab").record("speed", {"rate": float("nan")}, seed=3, folder=tmp_path / "new")
    assert json.loads(path.read_text()) == record


@pytest.mark.parametrize(("depths", "held_out"), [((True, True), 16 + 10 + 6), ((False, True), 16 + 10)])
def test_a_scene_is_split_anew_into_images_that_were_not_shown_before(
    script: Script, monkeypatch: pytest.MonkeyPatch, depths: tuple[bool, bool], held_out: int
) -> None:
    lab = script("_lab")
    camera = Intrinsics(30.0, 30.0, 16.0, 12.0, 32, 24)
    shots = [
        Shot(
            image=Path(f"{split}_{number}.png"),
            camera=camera,
            T_world_camera=SE3.identity(),
            depth=DepthFile("none", lambda: None) if has_depth else None,
            splits=(split,),
        )
        for split, count, has_depth in (("train", 12, depths[0]), ("test", 50, depths[1]))
        for number in range(count)
    ]
    monkeypatch.setenv("BIDNERF_DATA", "data")
    monkeypatch.setattr(lab, "open_dataset", lambda *_: Capture(Path("data/room"), shots))
    anew = {
        split: [s.name for s in lab.capture_of("room@new").shots if s.splits == (split,)] for split in ("train", "test")
    }
    shown = lab.spread(lab.without_tuning([s.name for s in shots if s.splits == ("test",)]), lab.FRAMES)
    assert anew["train"] == [f"train_{number}" for number in range(0, 12, 2)]
    assert len(anew["test"]) == held_out
    assert not {*anew["train"], *shown} & {*anew["test"]}
    half = [s.name for s in lab.capture_of("room@1").shots if s.splits == ("train",)]
    assert len(half) == 6
    assert half == [s.name for s in lab.capture_of("room@1").shots if s.splits == ("train",)]
    assert half != [s.name for s in lab.capture_of("room@2").shots if s.splits == ("train",)]
