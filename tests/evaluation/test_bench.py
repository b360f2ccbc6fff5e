"""Benches: planned from a seed, resumed after any kill, the same whoever runs them."""

from __future__ import annotations

import functools
import json
import math
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import pytest

import bidnerf as bn
from bidnerf.evaluation import (
    Plan,
    ResultsFile,
    ResultTable,
    Trial,
    TrialResult,
    list_trials,
    read_results,
    read_runs,
    run_trial,
    run_trials,
)

# Inside: lines of results
from bidnerf.evaluation.results import as_line
from bidnerf.scenes import closed_form_data
from bidnerf_core.datasets import DatasetOptions
from commands import CommandResult, Run, assert_refused
from refusals import refused

QUICK = ["--method", "bid", "--rays", "16", "--max-steps", "2", "--workers", "1"]
BLOBS = "demo:blobs"

pytestmark = pytest.mark.usefixtures("small_images")


@pytest.fixture
def evaluate(tmp_path: Path, bidnerf: Run) -> Run:
    """Runs it on the blobs with few rays and steps; the file is ``tmp_path / "r.jsonl"``."""
    return functools.partial(bidnerf, "evaluate", BLOBS, "--out", tmp_path / "r.jsonl", *QUICK)


def blob_trial(seed: int = 0, steps: int = 2) -> Trial:
    config = json.dumps({"rays": 16, "max_steps": steps})
    return Trial(BLOBS, BLOBS, (f"{seed:04d}",), (0.3,), seed, protocol="bid", method="bid", config=config)


@functools.cache
def ran(seed: int) -> TrialResult:
    """The result of a trial with two steps."""
    return run_trial(blob_trial(seed))


def trials_of(**options: Any) -> list[Trial]:
    return list_trials(Plan(**{"protocol": "bid"} | options), BLOBS, BLOBS, closed_form_data(BLOBS))


# Plans.


def test_a_plan_is_its_protocol_for_each_size() -> None:
    trials = trials_of()
    assert len(trials) == 72
    assert [trials[i].size for i in (0, 24, 48)] == [(0.5,), (0.8,), (1.2,)]
    assert [t.seed for t in trials[:24]] == [t.seed for t in trials[24:48]] == list(range(24))
    assert len({t.frame for t in trials[:24]}) == 24
    assert trials_of(seed=5)[0].seed == 5
    few = trials_of(sizes=[0.9], trials=5, frames=["0003", "0007"])
    assert sorted({t.frame for t in few}) == ["0003", "0007"]
    assert sorted({t.frame for t in trials_of(sizes=[0.9], trials=5, first=2)}) == ["0000", "0001"]
    (odd,) = trials_of(sizes=[[0.1]], trials=1, device="cpu:0", depth=False)
    assert (odd.device, odd.depth) == ("cpu:0", False)


@pytest.mark.parametrize(
    ("change", "found", "expected"),
    [
        (
            {"protocol": "inerf", "sizes": [0.5]},
            "size is 0.5",
            "no size with this protocol; bid, bid-hard and perturb have sizes",
        ),
        ({"frames": []}, "nothing to try", "at least one frame"),
        ({"frames": ["nope"]}, "no frame 'nope' among its 24 frames", "a name such as '0000'"),
        ({"images": DatasetOptions()}, "no split 'train'", "test"),
        ({"scene": "demo:object"}, "'demo:object'", "'bidnerf demo' trains maps"),
        ({"scene": "demo:blops"}, "'demo:blops'", "demo:blobs"),
        ({"data": "demo:rom"}, "'demo:rom'", "demo:room"),
        ({"device": "gpu"}, "device 'gpu' does not work", "cpu"),
        ({"device": "meta"}, "device 'meta' does not work", "cpu"),
        ({"device": "cuda:99"}, "device 'cuda:99' does not work", "cpu"),
    ],
)
def test_what_cannot_be_planned_is_refused(change: dict[str, Any], found: str, expected: str | None) -> None:
    scene, data = (change.pop(name, BLOBS) for name in ("scene", "data"))
    with refused(found=found, expected=expected):
        bn.evaluate(scene, data, Plan(**change))


def test_the_views_of_a_rig_are_localized_together() -> None:
    rig = replace(blob_trial(2), frames=("0000", "0001"))
    assert run_trial(rig).trial.frames == rig.frames


@pytest.mark.parametrize("name", ["demo:blobs", "demo:object", "demo:room"])
def test_closed_form_data_are_a_dataset(name: str) -> None:
    data = closed_form_data(name)
    views = data.views("test", ["0000", "0001"])
    assert [view.frame.name for view in views] == ["0000", "0001"]
    assert all(view.frame.has_depth for view in views)
    assert len(data.frame_names("test")) == 24


# Resuming.


@pytest.mark.parametrize("kept", [0.01, 0.5, 0.999, 1.0])
def test_a_half_written_last_line_is_dropped_and_nothing_else(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "r.jsonl"
    first, second = ran(0), ran(1)
    ResultTable((first, second)).save(path)
    whole, half = path.read_bytes(), as_line(second.plain())[:-1]
    path.write_bytes(as_line(first.plain()) + half[: math.ceil(kept * len(half))])
    known = [first, second] if kept == 1 else [first]  # the line of 1 lacks only its end
    assert read_results([path, path]) == known
    with ResultsFile(path) as file:
        assert list(file.values.values()) == known
        if kept < 1:
            file.add(second)
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"my notes", "line 1: not JSON"),
        (b'{"a": 1}', "line 1: T_world_camera: missing"),
        (b'{"T_world_camera": \n{}\n', "line 1: not JSON"),
        (b"\xff\xfe\n", "line 1: not JSON"),
    ],
)
def test_a_file_of_something_else_is_left_alone(tmp_path: Path, evaluate: Run, content: bytes, said: str) -> None:
    path = tmp_path / "r.jsonl"
    path.write_bytes(content)
    assert_refused(evaluate("--trials", 1), 1, said)
    assert path.read_bytes() == content


def test_a_file_is_written_by_one_at_a_time(tmp_path: Path, evaluate: Run) -> None:
    with ResultsFile(tmp_path / "r.jsonl"):
        assert_refused(evaluate("--trials", 1), 1, "another process is writing to it")


def test_results_come_in_the_order_of_the_plan(tmp_path: Path) -> None:
    trials = [blob_trial(seed) for seed in range(3)]
    with ResultsFile(tmp_path / "r.jsonl") as file:
        for seed in (9, 2, 1, 0):
            file.add(ran(seed))
        file.put_in_order(trials)
        file.add(ran(4))  # still the same file
    assert [r.seed for r in read_results([tmp_path / "r.jsonl"])] == [9, 0, 1, 2, 4]


def test_many_results_are_put_in_order_in_linear_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a fraction of a second of CPU time, where a search for each result would take half a minute."""
    monkeypatch.setattr("bidnerf.evaluation.results.key_of", str)
    with ResultsFile(None) as file:
        file.values = dict.fromkeys(map(str, reversed(range(20_000))), ran(0))
        began = time.process_time()
        file.put_in_order(range(20_000))  # type: ignore[arg-type]
        assert time.process_time() - began < 2
    assert list(file.values) == [str(number) for number in range(20_000)]


def test_more_trials_and_other_methods_go_into_the_same_file(
    tmp_path: Path, evaluate: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [str(Path(__file__).parents[2] / ".venv/bin/bidnerf"), "evaluate", BLOBS])
    evaluate("--trials", 2, "--size", 0.3).succeed()
    before = (tmp_path / "r.jsonl").read_bytes()
    assert "2 of 3 trials are already there" in evaluate("--trials", 3, "--size", 0.3).succeed().err
    assert (tmp_path / "r.jsonl").read_bytes().startswith(before)
    evaluate("--trials", 2, "--method", "inerf", "--protocol", "inerf").succeed()
    assert [r.method for r in read_results([tmp_path / "r.jsonl"])] == ["bid"] * 3 + ["inerf"] * 2
    assert len(read_runs(tmp_path / "r.jsonl")) == 3
    assert read_runs(tmp_path / "r.jsonl")[1].command == "bidnerf evaluate demo:blobs"


def test_another_training_of_the_map_is_not_mixed_in(tmp_path: Path, evaluate: Run) -> None:
    evaluate("--trials", 1, "--size", 0.3).succeed()
    path = tmp_path / "r.jsonl"
    content = path.read_text()
    path.write_text(content.replace('"weights": "exact"', '"weights": "other"'))
    other = "another training run of map demo:blobs (other, expected exact)"
    assert_refused(evaluate("--trials", 1, "--size", 0.3), 1, other)
    path.write_text(content.replace('"depth_weight": 1.0', '"depth_weight": 0.5'))
    assert "was made with depth_weight 0.5, expected 1.0" in evaluate("--trials", 1, "--size", 0.3).err
    path.write_text(content.replace('"depth_weight": 1.0, ', ""))  # by a version that did not know the setting
    assert "1 of 1 trials are already there" in evaluate("--trials", 1, "--size", 0.3).err


def test_results_of_other_images_are_refused(tmp_path: Path, data: Path, bidnerf: Run) -> None:
    """Folders are known by name, so the content decides: a moved copy is the same data, a changed one is not."""

    def run(photos: Path) -> CommandResult:
        trials = ["--size", 0.3, "--trials", 3]
        return bidnerf("evaluate", BLOBS, photos, "--out", tmp_path / "r.jsonl", *QUICK, *trials)

    run(data).succeed()
    before = (tmp_path / "r.jsonl").read_bytes()
    moved = run(Path(shutil.copytree(data, tmp_path / "moved" / "data"))).succeed()
    assert "3 of 3 trials are already there" in moved.err
    for what in ("images", "depth", "transforms.json"):
        changed = Path(shutil.copytree(data, tmp_path / what / "data"))
        if what == "transforms.json":
            about = json.loads((changed / what).read_text())
            for frame in about["frames"]:
                frame["transform_matrix"][0][3] += 0.25
            (changed / what).write_text(json.dumps(about))
        else:
            for image in (changed / what).glob("t_*.png"):
                iio.imwrite(image, iio.imread(image)[::-1])
        assert_refused(run(changed), 1, "made with other images, depth, masks or cameras")
    assert (tmp_path / "r.jsonl").read_bytes() == before


@pytest.mark.parametrize("replaced", [False, True])
def test_results_that_are_removed_meanwhile_are_missed(tmp_path: Path, replaced: bool) -> None:
    path = tmp_path / "r.jsonl"
    results = [ran(seed) for seed in range(2)]
    with ResultsFile(path) as file:
        file.add(results[0])
        path.unlink()
        if replaced:
            path.write_text("")
        with refused(where=path, found="was removed or replaced while it was being written"):
            file.add(results[1])
        with refused(where=path, found="was removed or replaced"):
            file.put_in_order([blob_trial(0)])


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"steps": 2', '"steps": 1' + "0" * 400, "holds 10000000"),
        (
            '"errors": {"translation": [',
            '"errors": {"translation": [1.0, ',
            "4 translation and 3 rotation errors",
        ),
        ('"reason": "', '"reason": "\\ud800', "line 1: not JSON"),
    ],
)
def test_numbers_and_text_that_nothing_can_hold_are_named(
    tmp_path: Path, bidnerf: Run, old: str, new: str, said: str
) -> None:
    line = as_line(ran(0).plain()).decode()
    assert old in line
    path = tmp_path / "r.jsonl"
    path.write_text(line.replace(old, new))
    assert_refused(bidnerf("report", path, "--out", tmp_path / "report"), 1, said)


# Running.


def test_a_trial_that_fails_ends_the_run_and_keeps_the_others(tmp_path: Path) -> None:
    good, bad = blob_trial(0), Trial(BLOBS, BLOBS, ("0000",), method="bid")
    with ResultsFile(tmp_path / "r.jsonl") as file, refused(found="method 'bid' needs a start"):
        run_trials([good, bad, blob_trial(1)], file)
    assert [r.seed for r in read_results([tmp_path / "r.jsonl"])] == [0]
