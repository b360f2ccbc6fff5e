"""Whatever saves files: where writing stops, at any of its writes, the earlier content stays or the new one is whole."""

from __future__ import annotations

import errno
import itertools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import pytest
import torch

import bidnerf as bn
from bidnerf.evaluation import (
    Comparison,
    ResultTable,
    Trial,
    note_run,
    provenance,
    read_runs,
)
from bidnerf.results import Answer, Answers, PosedImage, new_figure, write_figure
from bidnerf.results.pose_formats import POSE_WRITERS
from bidnerf_core.captures import write_inria_cameras
from bidnerf_core.io import is_temporary, write_file

# Inside: each writer is called by itself and stopped at each of its writes
from bidnerf_core.localization.tracking.motion import Clock
from bidnerf_core.localization.tracking.state import TrackerState
from bidnerf_core.maps import load_info, load_map, save_state, write_parts
from interruptions import FULL, Stopped, outcomes
from test_storage import CAMERAS, PARTS, assert_holds, info, names, plain, save_part, state
from trial_results import trial_result

CAMERA = bn.Intrinsics(8.0, 8.0, 4.0, 3.0, 8, 6)
POSE = bn.SE3.identity().to("cpu", torch.float64)
FOUND = bn.Localization(POSE, bn.Outcome.CONVERGED, "", 1, 0.1, 0.0, "auto", bn.SE3.stack([POSE]), torch.zeros(1))

Saver: TypeAlias = tuple[Callable[[Path, int], object], Callable[[Path], object]]
"""A function that saves content 1 or 2 into a folder, and one that reads it there; None where there is none."""


def file(name: str, save: Callable[[Path, int], object], read: Callable[[Path], object] = Path.read_bytes) -> Saver:
    return (
        lambda folder, number: save(folder / name, number),
        lambda folder: read(folder / name) if (folder / name).exists() else None,
    )


def part_of_a_map(name: str) -> Saver:
    def save(folder: Path, number: int) -> None:
        save_part(folder, load_info(folder), name, number - 1)

    def read(folder: Path) -> object:
        found = getattr(load_map(folder), name)
        return None if found is None else plain(found)

    return save, read


def whole_map(complete: bool) -> Saver:
    def save(folder: Path, number: int) -> None:
        write_parts(folder, info(number, complete), state(number))

    def read(folder: Path) -> object:
        if not names(folder):
            return None
        loaded = load_map(folder)
        assert_holds(loaded, state(loaded.info.step))
        assert names(folder) == {"map.json", loaded.info.weights, loaded.info.training} - {None}
        return loaded.info.step

    return save, read


def answers(path: Path, number: int) -> None:
    given = Answers()
    for n in range(number):
        given.append(Answer.of(bn.Frame(f"{n}", torch.zeros((6, 8, 3)), CAMERA), n, FOUND))
    given.write(path)


SAVERS: dict[str, Saver] = {
    "map": whole_map(complete=True),
    "checkpoint": whole_map(complete=False),
    **{name: part_of_a_map(name) for name in PARTS},
    "bytes": file("x", lambda path, n: write_file(path, bytes(n))),
    **{
        f"poses{ending}": file(
            f"poses{ending}",
            lambda path, number: bn.write_poses(path, [PosedImage(f"{n}", n, CAMERA, POSE) for n in range(number)]),
        )
        for ending in POSE_WRITERS
        if "scanner" not in ending
    },
    "localization": file(
        "found.json", lambda path, n: bn.Localization.save(FOUND.rejected(FOUND) if n > 1 else FOUND, path)
    ),
    "answers": file("found.json", answers),
    "results": file(
        "r.jsonl",
        lambda path, number: ResultTable(
            tuple(trial_result(Trial("m", "d", ("a",), seed=n), [1.0]) for n in range(number))
        ).save(path),
    ),
    "comparison": file("c.json", lambda path, n: Comparison("d", "test", "none", (), "auto", {}, 0, n, ()).save(path)),
    "runs": (
        lambda folder, n: note_run(folder / "r.jsonl", provenance("bidnerf evaluate", f"{n}")),
        lambda folder: [run.workers for run in read_runs(folder / "r.jsonl")] or None,
    ),
    "figure": file("a.png", lambda path, n: write_figure(new_figure(n, 1), path)),
    "tracker": file("state", lambda path, n: save_state(path, TrackerState(Clock(None, float(n))), "map")),
    "cameras": file("cameras.json", lambda path, n: write_inria_cameras(path.parent, CAMERAS[:n])),
}


@pytest.mark.parametrize("error", [FULL, Stopped()], ids=["full", "stop"])
@pytest.mark.parametrize("before", [True, False], ids=["second save", "first save"])
@pytest.mark.parametrize("name", SAVERS)
def test_a_save_that_fails_at_any_write_leaves_whole_files(
    name: str, before: bool, error: BaseException, tmp_path: Path
) -> None:
    (save, read), places = SAVERS[name], (tmp_path / str(number) for number in itertools.count())
    old, folder, seen = next(places), tmp_path, list[tuple[object, object]]()
    old.mkdir()
    if name in PARTS:
        write_parts(old, info(complete=True), state())
    if before:
        save(old, 1)
    kept = read(old)
    assert (kept is None) == (not before)

    def attempt() -> None:
        nonlocal folder
        folder = Path(shutil.copytree(old, next(places)))  # without a write that is counted
        save(folder, 2)

    for raised in outcomes(attempt, error):
        found = read(folder)
        seen.append((raised, found))
        assert not any(is_temporary(each) for each in names(folder))
        if isinstance(raised, OSError):
            assert (raised.errno, found) == (errno.ENOSPC, kept)
            assert str(raised.filename).startswith(str(folder))
            assert before or name.startswith("poses") or names(folder) == names(old)
    new = seen[-1][1]
    assert new not in (None, kept)
    assert len(seen) > {"map": 8, "checkpoint": 12}.get(
        name, 3
    )  # open, sync, replace, and sync the folder, of each file
    for raised, found in seen:
        assert found == new or (found == kept and raised is not None)
