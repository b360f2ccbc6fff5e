"""The benchmark of answers on record: its images, its file of rows, and how two files are compared."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import pytest
import torch

from bidnerf import SE3, Frame, Localization, View
from bidnerf.evaluation import faulty
from bidnerf_core.camera import Intrinsics
from bidnerf_core.errors import InputError
from localizations import answer, answer_row
from optional import require


@pytest.fixture(scope="module")
def answers(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("answers")


def view(name: str = "0007") -> View:
    generator = torch.Generator().manual_seed(0)
    rgb, depth = torch.rand((24, 32, 3), generator=generator), 1 + torch.rand((24, 32), generator=generator)
    return View(Frame(name, rgb, Intrinsics(30.0, 30.0, 16.0, 12.0, 32, 24), depth), SE3.identity())


def shift(metres: float, degrees: float = 0.0) -> SE3:
    angle = torch.deg2rad(torch.tensor(degrees, dtype=torch.float64))
    return SE3.exp(torch.tensor([metres, 0.0, 0.0, 0.0, 0.0, float(angle)], dtype=torch.float64))


def make_answer(T: SE3) -> Localization:
    return answer(T, covariance=torch.eye(6, dtype=torch.float64) / 3, confidence=0.9)


def row(error: float | None, accepted: bool, squared: float | None = 1.0, seconds: float = 1.0) -> Any:
    unknown = {"pose": None, "covariance": None, "reason": "", "confidence": None}
    return answer_row(error, accepted, squared, cpu_seconds=seconds, **unknown)


def write_rows(path: Path, rows: list[Any]) -> Path:
    keys = [["room", "RGB", "as it is", f"{place}"] for place in range(len(rows))]
    lines = [json.dumps({"key": json.dumps(key), "row": some}) for key, some in zip(keys, rows, strict=True)]
    path.write_text("".join(f"{text}\n" for text in lines))
    return path


def bytes_of(frame: Frame) -> list[bytes]:
    images = (frame.rgb, frame.depth)
    return [str(frame.intrinsics).encode(), *(b"" if i is None else i.numpy().tobytes() for i in images)]


def test_a_condition_changes_the_image_and_always_in_the_same_way(answers: ModuleType) -> None:
    for name, how in answers.CONDITIONS.items():
        if how.special or name == "as it is":
            continue
        once, again = (
            faulty(view(), how.change, 0).frame if isinstance(how.change, str) else how.change(view().frame)
            for _ in range(2)
        )
        assert bytes_of(once) == bytes_of(again), name
        assert bytes_of(once) != bytes_of(view().frame), name


def test_what_a_condition_draws_depends_on_the_frame(answers: ModuleType) -> None:
    here, there = (answers.wall(view(name).frame) for name in ("0007", "0008"))
    assert bytes_of(here) != bytes_of(there)


def test_a_picture_that_is_full_shows_nothing_beside_it(answers: ModuleType) -> None:
    frame = view().frame
    white = replace(frame, rgb=torch.ones_like(frame.rgb))
    assert bool((answers.picture(white, "full").rgb > 0.99).all())
    tilted = answers.picture(white, "tilted")
    assert 0.3 < float((tilted.rgb > 0.99).float().mean()) < 0.9
    assert len(require(tilted.depth).unique()) > 1


def test_an_answer_is_judged_by_the_nearest_right_pose(answers: ModuleType) -> None:
    poses = [shift(0.0), shift(1.0)]
    right = [replace(view(), T_ref_camera=T) for T in poses]
    found = make_answer(shift(1.01))
    question = answers.Question(("", "", "", ""), view().frame, lambda *_, **__: found, right, unit=2.0)
    given = question.answer()
    assert given["translation"] == pytest.approx(0.005)
    assert given["pose"] == found.T_world_camera.matrix()[:3].tolist()
    upper = torch.zeros(6, 6)
    upper[tuple(torch.triu_indices(6, 6))] = torch.tensor(given["covariance"])
    assert torch.equal(upper, (torch.eye(6, dtype=torch.float64) / 3).float())
    foreign = replace(question, right=()).answer()
    assert foreign["translation"] is None
    assert foreign["converged"]


def test_an_image_that_cannot_be_localized_is_an_answer(answers: ModuleType) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise InputError("no landmarks recognised")

    given = answers.Question(("", "", "", ""), view().frame, refuse, [view()]).answer()
    assert given["outcome"] == "raised InputError"
    assert given["reason"] == "no landmarks recognised"
    assert not given["converged"]
    assert answers.summary([given])["right"] == 0


def test_a_run_resumes_after_a_torn_line_and_refuses_another_map(
    answers: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    class Fake:
        content: ClassVar = ["weights"]

        def __init__(self, name: str) -> None:
            self.name = name

        def questions(self, share: float, only: Sequence[str]) -> Iterator[Any]:
            for frame in "abc":
                key = (self.name, "RGB", "as it is", frame)
                yield key, lambda key=key: self.question(key)

        def question(self, key: tuple[str, str, str, str]) -> Any:
            asked.append(key[3])
            return answers.Question(key, view().frame, lambda *_, **__: make_answer(shift(0.001)), [view()])

    monkeypatch.setattr(answers, "Subject", Fake)
    out = tmp_path / "rows.jsonl"
    answers.run(["room"], out, 1.0, ())
    whole = answers.read_rows(out)
    out.write_bytes(out.read_bytes()[:-20])
    answers.run(["room"], out, 1.0, ())
    assert asked == ["a", "b", "c", "c"]
    again = answers.read_rows(out)
    assert {key: answers.without_time(some) for key, some in again.items()} == {
        key: answers.without_time(some) for key, some in whole.items()
    }
    monkeypatch.setattr(Fake, "content", ["other weights"])
    with pytest.raises(InputError, match="answers of another map of room"):
        answers.run(["room"], out, 1.0, ())


def test_two_files_are_compared(answers: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Right and accepted, strictly right but rejected, wrong and accepted, and accepted without a right answer.
    rows = [row(0.03, True), row(0.01, False, seconds=3.0), row(9.0, True, 99.0), row(None, True, None)]
    first = write_rows(tmp_path / "a.jsonl", rows)
    answers.compare([first])
    lines = capsys.readouterr().out.splitlines()
    assert "| room | RGB | all | 4 | 2 | 1 | 3 | 2 | 1/2 | 0.46 | 1.00 | 3.00 |" in lines
    # Of ten answers that the first file has right, the second has none.
    right, wrong = [row(0.01, True)] * 10 + rows[:1], [row(9.0, True)] * 10 + rows[:1]
    answers.compare([write_rows(tmp_path / "b.jsonl", right), write_rows(tmp_path / "c.jsonl", wrong)])
    lines = capsys.readouterr().out.splitlines()
    assert "| right | 10 | 0 | 0.00195 |" in lines
    assert "| accepted | 0 | 0 | 1 |" in lines
    assert "| silent | 0 | 10 | 0.00195 |" in lines
    assert lines[-1] == (
        "Changed answers: any 10, pose 0, covariance 0, outcome 0, reason 0, confidence 0, pose beyond rounding 0"
    )  # rows of this test have no poses; their errors differ
    with pytest.raises(InputError, match="no answers that all files have"):
        answers.compare([first, write_rows(tmp_path / "d.jsonl", [])])


def test_rounding_moves_no_pose(answers: ModuleType) -> None:
    pose = SE3.identity().matrix()[:3]
    assert not answers.has_moved(pose.tolist(), (pose + 1e-9).tolist())
    assert answers.has_moved(pose.tolist(), (pose + 1e-4).tolist())
    assert answers.has_moved(None, pose.tolist())
    assert not answers.has_moved(None, None)


def test_a_record_is_compressed_and_compares_as_its_files(
    answers: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answers, "RESULTS", tmp_path)
    summaries: list[Any] = []
    monkeypatch.setattr(answers, "record", lambda name, results, seed: summaries.append(results))
    rows = write_rows(tmp_path / "a.jsonl", [row(0.03, True), row(9.0, False, None)])
    answers.keep([rows], "answers")
    assert answers.read_rows(tmp_path / "answers.rows.jsonl.xz") == answers.read_rows(rows)
    (results,) = summaries
    assert results["counts"]["room, RGB"]["all"]["right"] == 1
    assert results["counts"]["all, RGB"]["as it is"]["n"] == 2
