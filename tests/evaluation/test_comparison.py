"""Maps are compared from the same starts, each in a process of its own."""

from __future__ import annotations

import json
import shutil
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import imageio.v3 as iio
import pytest

import tiny
from bidnerf.cli import main

# Inside: rows and costs of single trials, from which a comparison is put together
from bidnerf.evaluation import (
    Comparison,
    Plan,
    Trial,
    TrialResult,
    compare,
    comparison_figure,
    list_trials,
    run_trial,
)
from bidnerf.evaluation.comparison import MapRow, map_bytes
from bidnerf.evaluation.run import InThisProcess, local_processes, terminate_on_failure
from bidnerf.evaluation.summary import success_of, summarize
from bidnerf_core.datasets import open_dataset
from bidnerf_core.io import from_plain
from commands import Run, assert_refused, strict
from optional import require
from refusals import refused
from trial_results import timeless, trial_result

pytestmark = pytest.mark.slow


QUICK = json.dumps({"rays": 32, "max_steps": 3})


@pytest.fixture(scope="module")
def data(shared: Path) -> Path:
    return shared / "data"


@pytest.fixture(scope="module")
def maps(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two that differ in how long they were trained."""
    folder = tmp_path_factory.mktemp("maps")
    made = [folder / "short", folder / "long"]
    assert main(["train", str(shared / "data"), "--out", str(made[0]), *tiny.options(4)]) == 0
    shutil.copytree(shared / "map", made[1])
    return made


@pytest.fixture(scope="module")
def plan() -> Plan:
    return Plan(protocol="bid", sizes=[0.5], method="bid", config=QUICK, trials=2)


@pytest.fixture(scope="module")
def compared(maps: list[Path], data: Path, plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Comparison:
    """Run from a folder with a file that bears the name of a module of Python's; one process serves both maps."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "statistics.py").write_text("raise SystemExit('a file of the user was run')")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        process = local_processes(1)
        patch.setattr("bidnerf.evaluation.comparison.local_processes", lambda count: process)
        return compare(maps, data, plan)


def result(times: float, trace: list[float], seconds: float = 1.0) -> TrialResult:
    """One whose distance went as ``trace`` says; one step took ``seconds`` in all."""
    return trial_result(Trial("m", "d", ("r_0",)), [times * x for x in trace], seconds=seconds)


def test_every_map_is_tried_on_the_same_frames_from_the_same_starts(compared: Comparison) -> None:
    first, second = compared.results
    assert [(r.frame, r.seed, r.start_error) for r in first] == [(r.frame, r.seed, r.start_error) for r in second]
    assert [r.errors.translation[0] for r in first] == pytest.approx([0.5, 0.5], abs=0.02)  # the chord of a screw
    assert first[0].T_world_camera != second[0].T_world_camera


def test_a_process_elsewhere_finds_what_this_one_finds(
    compared: Comparison, maps: list[Path], plan: Plan, data: Path
) -> None:
    for place in (0, 1):
        trials, found = (
            list_trials(plan, str(maps[place]), str(data), open_dataset(data)),
            compared.results[place],
        )
        again, found = run_trial(trials[place]), found[place]
        assert timeless([again]) == timeless([found])


def test_a_row_says_what_the_map_costs(compared: Comparison, maps: list[Path]) -> None:
    assert [r.map for r in compared.rows] == ["short", "long"]
    for found, folder in zip(compared.rows, maps, strict=True):
        assert found.map_bytes == map_bytes(folder) == sum(f.stat().st_size for f in folder.iterdir())
        assert found.peak_memory_bytes > 50 * 2**20  # a Python with torch in it
        assert found.ms_per_step > 0
        assert found.steps == 3


def test_speed_is_that_of_the_trials_that_succeeded() -> None:
    quick, slow = result(1.0, [1.0, 0.05, 0.05], 0.2), result(1.0, [1.0, 0.5, 0.5, 0.05, 0.05], 2.0)
    lost = result(1.0, [1.0, 0.05, 0.9], 50.0)  # met it on the way only
    found = success_of([quick, slow, lost], "10%")
    assert (found.rate.successes, found.rate.trials) == (2, 3)
    assert found.steps == 2  # of 1 and 3
    assert found.milliseconds == pytest.approx((100 + 1500) / 2)
    assert success_of([lost], "10%").milliseconds is None


def test_a_title_counts_trials_and_starts() -> None:
    found = Comparison("room", "test", "none", (), "auto", {}, 0, 1, (), ())
    assert found.title == "1 trial without a start on room/test, method auto"
    found = replace(found, protocol="bid", size=(0.5,), trials=2)
    assert found.title == "2 starts of bid 0.5 on room/test, method auto"


def test_a_median_error_counts_lost_poses_as_worst() -> None:
    good, gone = result(0.1, [1.0, 0.1]), replace(result(0.1, [1.0, 0.1]), error=None)
    assert summarize([good, good, gone]).translation == pytest.approx(0.01)
    assert summarize([good, gone, gone]).translation is None


def test_without_a_start_there_is_no_share_of_its_error(tmp_path: Path) -> None:
    free = replace(result(1.0, [0.04, 0.01]), start_error=None)
    row = MapRow(map="short", backend="vanilla", weights="", map_bytes=0, **vars(summarize([free])))
    assert row.success["10%"] is None
    absolute = require(row.success["5deg 0.05"])
    assert (absolute.rate.successes, absolute.steps) == (1, 0)
    found = Comparison("d", "test", "none", (), "auto", {}, 0, 1, (row,), ((free,),))
    assert "<svg" in comparison_figure(tmp_path, found).read_text()
    assert "step" not in str(found).partition("\n")[2].partition("success:")[0]  # the method has no steps


def test_no_maps_are_no_comparison(data: Path) -> None:
    with refused(found="no maps", expected="at least one"):
        compare([], data)


def test_a_process_that_ends_is_told_in_one_line(
    maps: list[Path], data: Path, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(InThisProcess, "submit", Mock(side_effect=BrokenProcessPool()))
    monkeypatch.setattr("bidnerf.evaluation.comparison.local_processes", lambda count: InThisProcess())
    with refused(where=maps[0], found="frame t_0002 ended", expected="memory"):
        compare([maps[0]], data, plan)


def test_a_failure_ends_the_processes_with_their_trials() -> None:
    for failure in (LookupError, None):
        pool, process = InThisProcess(), Mock()
        vars(pool)["_processes"] = {7: process}
        with suppress(LookupError), terminate_on_failure(pool):
            if failure is not None:
                raise failure
        assert process.terminate.called == (failure is not None)


def test_the_picture_is_written(compared: Comparison, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    drawn = comparison_figure(tmp_path, compared)
    image = iio.imread(drawn.with_suffix(".png"))
    assert image.shape[0] > 400
    assert image[..., :3].std() > 5
    assert "<svg" in drawn.read_text()


@pytest.mark.usefixtures("no_processes")
def test_the_command_prints_a_table_and_writes_what_it_says(
    maps: list[Path], data: Path, tmp_path: Path, bidnerf: Run
) -> None:
    quick = ["--method", "bid", "--trials", 2, "--rays", 32, "--max-steps", 2]
    compare = ["compare", maps[0], data, *quick, "--out", tmp_path / "out"]
    shown = bidnerf(*compare).succeed()
    assert "short" in shown.out
    assert "ms a step" in shown.out
    assert "2/2 trials" in shown.err
    kept = from_plain(Comparison, json.loads((tmp_path / "out" / "compare.json").read_text()), "compare.json")
    assert [len(column) for column in kept.results] == [2]
    assert_refused(bidnerf(*compare), 1, "not empty")  # what is there is not overwritten
    found = strict(bidnerf("compare", maps[0], data, *quick, "--size", 0.3, "--frame", "t_0001", "--json").out)
    assert found["size"] == [0.3]
    assert found["rows"][0]["success"]["10%"]["rate"]["trials"] == 2
