"""What a kill leaves behind is taken over, a full disk leaves whole files, and a second process is refused."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

import tiny

# Inside: a lock is taken late, as if between two steps of another process; names of temporary files
from bidnerf_core.io import FileInUse, files, lock, output_folder
from bidnerf_core.maps import load_map
from commands import Run

BAKE = ["--cells", "2000"]


def test_a_training_killed_before_its_first_checkpoint_begins_anew(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    out = tmp_path / "map"
    out.mkdir()
    for left in (
        ".writable.0123abcd",
        ".map.json.0123abcd",
        "weights-00000001-0123abcd.safetensors",
        ".weights-00000001-0123abcd.safetensors.89abcdef",
    ):
        (out / left).write_bytes(b"half")
    assert bidnerf("train", shared / "data", "--out", out, *tiny.options(2)).status == 0
    whole = {".writable.0123abcd", "map.json", load_map(out).info.weights}
    assert {path.name for path in out.iterdir()} == whole


def test_a_map_that_another_process_writes_is_not_baked(bidnerf: Run, shared: Path, map_folder: Path) -> None:
    with lock(map_folder):
        status, said, err = bidnerf("bake", map_folder, "--data", shared / "data", *BAKE)
    assert (status, said, err.count("\n")) == (1, "", 1)
    assert "another bidnerf process is writing here" in err


def test_a_folder_is_not_removed_from_under_another_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that fails removes the folder that it made, in which another one may have begun to work meanwhile."""
    out, remove = tmp_path / "map", Path.rmdir
    refused: list[bool] = []

    def removed(folder: Path) -> None:
        monkeypatch.setattr(Path, "rmdir", remove)
        try:
            with output_folder(folder, overwrite=False):
                remove(folder)
                (folder / "file").write_text("of the other one")
        except FileInUse:
            refused.append(True)
        remove(folder)

    monkeypatch.setattr(Path, "rmdir", removed)
    with pytest.raises(LookupError), output_folder(out, overwrite=False):
        raise LookupError
    assert refused == [True]
    assert not out.exists()


def test_a_folder_that_was_removed_has_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileInUse), lock(tmp_path / "none"):
        pass
    (tmp_path / "map").mkdir()
    take = files.take_lock

    def taken_late(number: int) -> bool:
        (tmp_path / "map").rmdir()
        return take(number)

    monkeypatch.setattr(files, "take_lock", taken_late)
    with pytest.raises(FileInUse), lock(tmp_path / "map"):
        pass


def test_a_lock_ends_with_its_process(tmp_path: Path) -> None:
    """Nothing is left of the lock of a process that was killed, so there is nothing to take over."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        with lock(tmp_path):
            os.write(writing, b"x")
            signal.pause()
    assert os.read(reading, 1) == b"x"
    with pytest.raises(FileInUse), lock(tmp_path):
        pass
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with lock(tmp_path):
        pass
    os.close(reading)
    os.close(writing)
