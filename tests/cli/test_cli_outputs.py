"""What a command has found is kept whatever ends it, and its outputs never replace what it reads."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import logging
import math
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn
from unittest.mock import Mock

import pytest
import torch

# Inside: signals within sections that a command passes in microseconds, and paths that it must refuse
from bidnerf import SE3, Cancelled, Frame, InputError, Intrinsics, Localization, Localizer, Outcome, Tracker
from bidnerf.cli import main
from bidnerf.cli.output import check_folder, check_output
from bidnerf.cli.running import interruptible_work
from bidnerf.cli.signals import Interrupted, defer_interruptions, interruptions
from bidnerf.results import Answer, Answers
from bidnerf_core.datasets import DatasetFrames, Query, read_trajectory
from bidnerf_core.errors import UsageError
from bidnerf_core.maps import Map
from bidnerf_core.progress import check_cancelled
from bidnerf_core.registry import registered
from commands import Run, assert_refused
from flights import flight
from stored_ground import open_ground, write_flight

FRAMES = 4
CAMERA = Intrinsics(width=4, height=3, fx=4.0, fy=4.0, cx=2.0, cy=1.5)
T = SE3.exp(torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], dtype=torch.float64))
FOUND = Localization(
    T, Outcome.CONVERGED, "", 1, 0.1, 0.0, "auto", SE3.stack([T]), torch.zeros(1), torch.eye(6).double()
)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flight(tmp_path_factory.mktemp("outputs") / "data", [(f, T) for _, f, T in flight()[:FRAMES]])


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands open a map in memory, and each localization and each step of a tracker gives the same answer at once."""
    open_ground(monkeypatch)
    monkeypatch.setattr(Localizer, "__call__", lambda self, *given, **more: FOUND)
    monkeypatch.setattr(Tracker, "__call__", lambda self, frame, time: FOUND)


@pytest.fixture
def third(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], None]:
    """Makes something happen when the third frame is read."""

    def at_third(act: Callable[[], object]) -> None:
        calls, read, step = list[int](), DatasetFrames.read, Tracker.__call__

        def counted() -> None:
            calls.append(1)
            if len(calls) == 3:
                act()

        def reading(source: DatasetFrames, place: int) -> Query:
            counted()
            return read(source, place)

        def stepping(tracker: Tracker, frame: Frame, time: float | None) -> Localization:
            counted()
            return step(tracker, frame, time)

        monkeypatch.setattr(DatasetFrames, "read", reading)
        monkeypatch.setattr(Tracker, "__call__", stepping)

    return at_third


@pytest.fixture
def no_signal_ignored() -> Iterator[None]:
    """Signals as in a terminal, also where the tests run in the background, which ignores some of them."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("no_signal_ignored")
@pytest.mark.parametrize("command", ["localize", "track"])
@pytest.mark.parametrize(
    ("end", "status"),
    [
        (lambda: os.kill(os.getpid(), signal.SIGTERM), 143),
        (lambda: os.kill(os.getpid(), signal.SIGHUP), 129),
        (lambda: os.kill(os.getpid(), signal.SIGINT), 130),
        (Mock(side_effect=BrokenPipeError), 141),
        (Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))), 1),
    ],
    ids=["SIGTERM", "SIGHUP", "SIGINT", "closed pipe", "full disk"],
)
def test_any_end_of_a_run_keeps_the_poses(
    bidnerf: Run,
    data: Path,
    tmp_path: Path,
    third: Callable[[Any], None],
    command: str,
    end: Callable[[], None],
    status: int,
) -> None:
    third(end)
    found = bidnerf(command, "MAP", data, "--out", tmp_path / "poses.txt")
    assert found.status == status, found.err
    assert "Traceback" not in found.err
    assert len(read_trajectory(tmp_path / "poses.txt")) == 2


@pytest.mark.parametrize("words", [[], ["--json"]])
def test_a_reader_that_goes_away_keeps_the_poses(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
) -> None:
    class FirstLine(io.StringIO):
        def write(self, text: str) -> int:
            if self.tell():
                raise BrokenPipeError
            return super().write(text)

        def fileno(self) -> int:
            return os.open(os.devnull, os.O_WRONLY)

    monkeypatch.setattr(sys, "stdout", FirstLine())
    out = tmp_path / "poses.json"
    assert main(["localize", "MAP", str(data), "--out", str(out), *words]) == 141
    assert [found["frame"] for found in json.loads(out.read_text())] == [f.name for _, f, _ in flight()[:2]]


@pytest.mark.usefixtures("no_signal_ignored")
@pytest.mark.parametrize(
    ("words", "place", "kept"),
    [
        (["demo", "--out", "OUT"], "bidnerf_core.maps.train", "'bidnerf demo --out OUT --overwrite' starts again"),
        (["import", "FILE", "--out", "OUT"], "bidnerf_core.maps.import_map", "OUT was not written"),
    ],
)
def test_an_interrupted_command_advises_what_it_can_do(
    words: list[str], place: str, kept: str, bidnerf: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: Any, **__: Any) -> NoReturn:
        os.kill(os.getpid(), signal.SIGINT)
        raise Cancelled("map: saved after step 3; `resume` continues from there")

    monkeypatch.chdir(tmp_path)
    (tmp_path / "FILE").touch()
    monkeypatch.setattr(place, stopped)
    monkeypatch.setattr("bidnerf.cli.demo.TRAINING_VIEWS", 2)
    status, _, err = bidnerf(*words)
    assert status == 130
    assert kept in err
    assert "--resume" not in err


@pytest.mark.parametrize(
    ("interrupted", "error", "expected"),
    [
        (True, RecursionError("of an import"), Interrupted),  # as of NumPy's
        (True, OSError("full disk"), OSError),
        (True, InputError("what a user can mend"), InputError),
        (False, RecursionError("of our own"), RecursionError),
    ],
)
def test_an_unexpected_error_after_a_signal_is_an_interruption(
    interrupted: bool, error: Exception, expected: type[BaseException]
) -> None:
    def fail() -> None:
        with interruptions():
            if interrupted:
                with contextlib.suppress(KeyboardInterrupt):
                    signal.raise_signal(signal.SIGTERM)
            raise error

    with pytest.raises(expected):
        fail()


def test_an_interruption_that_python_ignores_is_raised_again(capfd: pytest.CaptureFixture[str]) -> None:
    class Ignoring:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    def work() -> None:
        with interruptions():
            Ignoring()
            until = time.monotonic() + 30
            while time.monotonic() < until:
                time.sleep(0.01)

    with pytest.raises(Interrupted, match="SIGTERM"):
        work()
    assert capfd.readouterr().err == ""


def test_handlers_are_as_before_after_a_command_and_ignored_signals_stay_ignored(bidnerf: Run) -> None:
    asked_to_stop, logger = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP), logging.getLogger("bidnerf")
    before = [signal.getsignal(number) for number in asked_to_stop]
    printed = logger.handlers[:], logger.isEnabledFor(logging.INFO)
    bidnerf("backends")
    assert before == [signal.getsignal(number) for number in asked_to_stop]
    assert printed == (logger.handlers, logger.isEnabledFor(logging.INFO))
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptions():
            os.kill(os.getpid(), signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before[2])


@pytest.mark.usefixtures("no_signal_ignored")
def test_ctrl_c_is_acknowledged_before_the_work_can_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = list[str]()
    monkeypatch.setattr("bidnerf.cli.running.say", lines.append)

    def work() -> None:
        with interruptions(), interruptible_work("will stop"):
            os.kill(os.getpid(), signal.SIGINT)
            until = time.monotonic() + 10
            while not lines and time.monotonic() < until:
                time.sleep(0.01)
            assert lines == ["will stop"]
            check_cancelled("this work")

    with pytest.raises(Interrupted):
        work()
    assert lines == ["will stop", "cancelled during stage 'this work'"]


def test_an_interruption_while_results_are_written_waits_for_them() -> None:
    written = list[int]()

    def write() -> None:
        with interruptions(), defer_interruptions():
            os.kill(os.getpid(), signal.SIGTERM)
            written.append(1)

    with pytest.raises(Interrupted) as stopped:
        write()
    assert (written, stopped.value.number) == ([1], signal.SIGTERM)


def test_a_forked_worker_ends_by_the_signal_as_without_a_handler() -> None:
    reading, writing = os.pipe()
    with interruptions():
        child = os.fork()
        if child == 0:
            try:
                os.write(writing, b"x")
                for _ in range(200):
                    time.sleep(0.1)
            finally:
                os._exit(7)
        os.read(reading, 1)  # it is past the fork, which drops signals
        os.kill(child, signal.SIGTERM)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGTERM
    os.close(reading)
    os.close(writing)


def test_a_picture_that_cannot_be_written_ends_the_run_and_keeps_the_poses(
    bidnerf: Run, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = DatasetFrames.read
    monkeypatch.setattr(DatasetFrames, "read", lambda self, n: replace(read(self, n), name="x" * 250))
    found = bidnerf("localize", "MAP", data, "--draw", tmp_path / "drawn", "--out", tmp_path / "poses.txt")
    assert found.status == 1
    assert found.err.endswith("File name too long\n")
    assert len(read_trajectory(tmp_path / "poses.txt")) == 1


def test_a_frame_that_is_not_finite_is_null_and_the_others_are_written(
    bidnerf: Run, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    odd = [
        FOUND,
        replace(FOUND, T_world_camera=SE3(T.rotation, T.translation * torch.tensor([1.0, math.nan, math.inf]))),
        replace(FOUND, covariance=torch.eye(6).double() * math.inf),
        replace(FOUND, loss=math.nan, confidence=math.inf, focal_factor=math.nan),
    ]
    for name, more in (
        ("poses.json", ["--plot", tmp_path / "p.png"]),
        ("poses.txt", []),
        ("transforms.json", []),
    ):
        answers = iter(odd)
        monkeypatch.setattr(Tracker, "__call__", lambda self, frame, time, answers=answers: next(answers))
        bidnerf("track", "MAP", data, "--out", tmp_path / name, *more).succeed()
    poses = json.loads((tmp_path / "poses.json").read_text())
    assert [pose["T_world_camera"] is None for pose in poses] == [False, True, False, False]
    assert [pose["covariance"] is None for pose in poses] == [False, False, True, False]
    assert {poses[3][key] for key in ("loss", "confidence", "focal_factor")} == {None}
    assert len(read_trajectory(tmp_path / "poses.txt")) == FRAMES - 1  # the pose itself is left out
    assert len(json.loads((tmp_path / "transforms.json").read_text())["frames"]) == FRAMES - 1


def test_a_path_of_no_finite_pose_has_no_plot(tmp_path: Path) -> None:
    path = Answers(is_sequence=True)
    nowhere = replace(FOUND, T_world_camera=SE3(T.rotation, T.translation * math.nan))
    path.append(Answer.of(Frame("a", torch.zeros((3, 4, 3)), CAMERA), 0, nowhere))
    with pytest.raises(InputError, match="no frame was tracked"):
        path.plot(tmp_path / "plot.png")


# Outputs that would replace inputs.


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with a map, a dataset, a photo and a start."""
    for name in ("map/map.json", "data/images/a.png", "photo.png", "start.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("kept")
    return tmp_path


@pytest.mark.parametrize(
    "out",
    [
        "map/poses.json",
        "map/map.json",
        "photo.png",
        "start.json",
        "data/images/a.png",
        "link.json",
        "data/../photo.png",
    ],
)
def test_a_file_that_is_read_or_of_a_map_is_no_output(files: Path, out: str) -> None:
    (files / "link.json").symlink_to(files / "start.json")
    with pytest.raises(UsageError, match=re.escape(str(files / out))):
        check_output(
            files / out, (files / "photo.png", None, files / "start.json", str(files / "data")), overwrite=True
        )


def test_a_folder_in_which_no_file_can_be_created_is_refused_before_any_work(
    bidnerf: Run, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse = Mock(side_effect=OSError(errno.EROFS, os.strerror(errno.EROFS)))
    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    for words in (
        ["localize", "MAP", data, "--out", tmp_path / "poses.json"],
        ["localize", "MAP", data, "--draw", tmp_path / "drawn"],
        ["track", "MAP", data, "--out", tmp_path / "poses.txt"],
        ["view", "MAP", data, "--save", tmp_path / "page.html"],
    ):
        assert_refused(bidnerf(*words), 1, words[-1], "Read-only file system")


def test_a_map_and_a_model_that_exist_are_refused_before_any_work(bidnerf: Run, data: Path, files: Path) -> None:
    with pytest.raises(UsageError, match="exists already"):
        check_folder(files / "map", ())
    (files / "points3D.txt").write_text("of another program")
    for command in ("localize", "track"):
        found = bidnerf(command, "MAP", data, "--out", files / "images.txt")
        assert_refused(found, 1, files / "points3D.txt", "would be replaced")


def test_a_file_that_exists_is_replaced_only_if_the_user_says_so(bidnerf: Run, files: Path) -> None:
    photo, out = files / "photo.png", files / "start.json"
    for words in (["localize", "MAP", photo, "--out"], ["track", "MAP", photo, "--out"]):
        assert_refused(bidnerf(*words, out), 1, out, "exists already", "--overwrite")
        assert "exists already" not in bidnerf(*words, out, "--overwrite").err


def test_what_a_format_or_a_page_needs_is_checked_before_a_map_is_loaded(
    bidnerf: Run, shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(scene: Map, out: Path) -> list[Path]:
        """A mesh."""
        raise AssertionError

    load = Mock(side_effect=AssertionError("loaded"))
    vars(write)["needs"] = ("surface",)
    monkeypatch.setitem(registered, ("exporters", "mesh.new"), write)
    monkeypatch.setattr("bidnerf.results.export.load_map", load)
    monkeypatch.setattr("bidnerf_core.maps.load_map", load)
    found = bidnerf("export", shared / "map", "--to", "mesh.new", "--out", tmp_path / "out")
    assert_refused(found, 1, shared / "map", "no surface", "'bidnerf bake'")
    assert not (tmp_path / "out").exists()
    monkeypatch.setitem(sys.modules, "uvicorn", None)  # as where the extra is not installed
    assert_refused(bidnerf("view", shared / "map"), 1, "pip install 'bidnerf[viewer]'", "--save")
    assert_refused(bidnerf("serve", shared / "map", "--device", "cudaa"), 1, "pip install 'bidnerf[serve]'")


def test_new_files_beside_inputs_are_outputs(files: Path) -> None:
    for name in ("poses.json", "data/poses.json", "start.json"):
        check_output(files / name, (files / "photo.png", files / "data", files / "missing"), overwrite=True)


@pytest.mark.parametrize("errors", ["strict", "surrogateescape"])
def test_what_a_stream_cannot_encode_is_escaped(monkeypatch: pytest.MonkeyPatch, errors: str) -> None:
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors=errors)
    monkeypatch.setattr(sys, "stdout", stream)
    assert main(["--help"]) == 0
    print("20 °")
    stream.flush()
    assert stream.buffer.getvalue().endswith(b"20 \\xb0\n")  # type: ignore[attr-defined]
