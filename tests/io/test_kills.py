"""What a kill leaves behind is taken over, a full disk leaves whole files, and a second process is refused."""

from __future__ import annotations

import errno
import itertools
import os
import shutil
import signal
from pathlib import Path

import pytest

import tiny
from bidnerf_core.cli import main
from bidnerf_core.io import FileInUse, files, is_temporary, locked, output_folder, write_file
from bidnerf_core.io.files import temporary
from bidnerf_core.maps import load_map
from bidnerf_core.results import new_figure, save_figure
from commands import Run

pytestmark = pytest.mark.slow


BAKE = ["--cells", "2000"]
QUICK = ["--trials", "2", "--workers", "1", "--method", "bid", "--max-steps", "1", "--rays", "32"]


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("kills")
    tiny.write_dataset(folder / "data")
    assert main(["train", str(folder / "data"), "--out", str(folder / "map"), *tiny.options(4)]) == 0
    assert main(["evaluate", "demo:blobs", "--out", str(folder / "r.jsonl"), *QUICK]) == 0
    return folder


def temporaries(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob("*") if is_temporary(path.name)]


def test_temporary_names_are_recognised_and_others_are_not(tmp_path: Path) -> None:
    assert is_temporary(temporary(tmp_path / "map.json").name)
    for name in ("map.json", ".hidden", ".map.json.bak", "a.0123abcd", ".gitignore"):
        assert not is_temporary(name)


@pytest.mark.parametrize(
    "left",
    [
        ".writable.0123abcd",
        ".map.json.0123abcd",
        "weights-00000001-0123abcd.safetensors",
        ".weights-00000001-0123abcd.safetensors.89abcdef",
    ],
)
def test_a_training_killed_before_its_first_checkpoint_begins_anew(
    left: str, bidnerf: Run, shared: Path, tmp_path: Path
) -> None:
    out = tmp_path / "map"
    out.mkdir()
    (out / left).write_bytes(b"half")
    assert bidnerf("train", shared / "data", "--out", out, *tiny.options(2)).status == 0
    assert {path.name for path in out.iterdir()} - {".writable.0123abcd"} == {
        "map.json",
        load_map(out).info.weights,
    }


def test_files_of_others_and_of_whole_maps_are_not_overwritten(
    bidnerf: Run, shared: Path, tmp_path: Path
) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "weights.txt").touch()
    for out in (tmp_path / "notes", shared / "map"):
        status, _, err = bidnerf("train", shared / "data", "--out", out, *tiny.options(2))
        assert status == 1
        assert "exists already and is not empty" in err


def test_a_report_killed_before_its_page_begins_anew(bidnerf: Run, shared: Path, tmp_path: Path) -> None:
    out = tmp_path / "report"
    out.mkdir()
    (out / ".index.html.0123abcd").write_text("<html")
    assert bidnerf("report", shared / "r.jsonl", "--out", out).status == 0
    assert (out / "index.html").read_text().endswith("</html>\n")


def test_a_figure_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    figure = new_figure(2, 2)
    save_figure(figure, tmp_path, "a")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == {"a.png", "a.svg"}
    with monkeypatch.context() as patch:
        fail_from(patch, 1)
        with pytest.raises(OSError, match=r"a\.png"):
            save_figure(new_figure(3, 3), tmp_path, "a")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def fail_from(patch: pytest.MonkeyPatch, number: int) -> None:
    """Let the ``number``-th flush to the disk fail, and each after it, as where the disk is full."""
    real, count = os.fsync, itertools.count(1)

    def fsync(file: int) -> None:
        if next(count) >= number:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(file)

    patch.setattr(os, "fsync", fsync)


@pytest.mark.parametrize(
    "command", ["train", "bake", "evaluate", pytest.param("report", marks=pytest.mark.slow)]
)
def test_a_disk_that_is_full_at_any_write_leaves_whole_files(
    command: str, bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = 0
    for number in (1, 2, 100):
        folder = tmp_path / str(number)
        shutil.copytree(shared / "map", folder / "map")
        words = {
            "train": [
                "train",
                shared / "data",
                "--out",
                folder / "new",
                *tiny.options(2),
                "--checkpoint-every",
                "0",
            ],
            "bake": ["bake", folder / "map", "--data", shared / "data", *BAKE],
            "evaluate": ["evaluate", "demo:blobs", "--out", folder / "r.jsonl", *QUICK],
            "report": ["report", shared / "r.jsonl", "--out", folder / "report"],
        }[command]
        with monkeypatch.context() as patch:
            fail_from(patch, number)
            status, _, err = bidnerf(*words)
        if status == 0:
            break
        failed += 1
        assert (status, "No space left on device" in err.splitlines()[-1]) == (1, True), err
        assert temporaries(folder) == []
        load_map(folder / "map")
    assert failed == 2
    assert bidnerf(*words).status == (1 if command == "train" else 0)  # which exists already


def test_a_map_that_another_process_writes_is_not_baked(bidnerf: Run, shared: Path) -> None:
    with locked(shared / "map"):
        status, said, err = bidnerf("bake", shared / "map", "--data", shared / "data", *BAKE)
    assert (status, said, err.count("\n")) == (1, "", 1)
    assert "another bidnerf process is writing here" in err


def test_a_folder_is_not_removed_from_under_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    with pytest.raises(FileInUse), locked(tmp_path / "none"):
        pass
    (tmp_path / "map").mkdir()
    take = files.take_lock

    def taken_late(number: int) -> bool:
        (tmp_path / "map").rmdir()
        return take(number)

    monkeypatch.setattr(files, "take_lock", taken_late)
    with pytest.raises(FileInUse), locked(tmp_path / "map"):
        pass


def test_a_lock_ends_with_its_process(shared: Path) -> None:
    """Nothing is left of the lock of a process that was killed, so there is nothing to take over."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        with locked(shared / "map"):
            os.write(writing, b"x")
            signal.pause()
    assert os.read(reading, 1) == b"x"
    with pytest.raises(FileInUse), locked(shared / "map"):
        pass
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with locked(shared / "map"):
        pass
    os.close(reading)
    os.close(writing)


def test_what_cannot_be_written_names_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_from(monkeypatch, 1)
    with pytest.raises(OSError, match=r"a\.txt") as caught:
        write_file(tmp_path / "a.txt", b"x")
    assert caught.value.errno == errno.ENOSPC
    assert list(tmp_path.iterdir()) == []
