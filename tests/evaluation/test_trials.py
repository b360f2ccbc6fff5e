"""A trial depends on what it says alone, and its line says everything."""

from __future__ import annotations

import dataclasses
import json
import math
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
import torch

import tiny
from bidnerf_core.cli import main
from bidnerf_core.evaluation import (
    Trace,
    Trial,
    TrialResult,
    forget_peak_memory,
    peak_memory_bytes,
    run_trial,
)
from bidnerf_core.geometry import SE3
from bidnerf_core.io import to_plain
from bidnerf_core.results import pose_error
from refusals import refused

QUICK = '{"max_steps": 4, "rays": 64}'


@pytest.fixture
def trial(shared: Path) -> Trial:
    folders = str(shared / "map"), str(shared / "data")
    return Trial(*folders, ("t_0001",), (0.5,), 3, protocol="bid", method="bid", config=QUICK)


def timeless(result: TrialResult) -> TrialResult:
    return dataclasses.replace(result, seconds=0.0, peak_memory_bytes=0)


def test_a_line_has_what_localize_prints_and_more(
    trial: Trial, shared: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    line = to_plain(run_trial(trial))
    capsys.readouterr()
    assert main(["localize", str(shared / "map"), str(shared / "data"), "--frame", "t_0001", "--json",
                 "--method", "bid", "--perturb", "0.1", "5", "--max-steps", "2", "--rays", "32"]) == 0  # fmt: skip
    assert json.loads(capsys.readouterr().out).keys() <= line.keys()
    assert json.loads(json.dumps(line, allow_nan=False)) == line
    assert line["frame"] == "t_0001"
    assert line["seed"] == 3
    assert line["steps"] == 4
    assert line["start_error"]["translation"] == pytest.approx(0.5, rel=0.01)  # exp bends it a little
    assert line["start_error"]["rotation_deg"] == pytest.approx(math.degrees(0.2))
    for kind in ("translation", "rotation_deg"):
        assert len(line["errors"][kind]) == 5
        assert line["errors"][kind][0] == pytest.approx(line["start_error"][kind])
        assert line["errors"][kind][-1] == pytest.approx(line["error"][kind])
    assert line["settings"]["rays"] == 64
    assert line["settings"]["depth_weight"] == 1.0
    assert line["weights"].startswith("weights-")
    assert line["peak_memory_bytes"] > 10**7


def test_its_trial_has_the_names_of_folders_alone(trial: Trial) -> None:
    found = run_trial(trial).trial
    assert found == trial.portable == trial.portable.portable
    assert hash(found) == hash(trial.portable)


def test_its_error_is_that_of_its_pose(trial: Trial, shared: Path) -> None:
    result = run_trial(trial)
    matrix = torch.tensor(result.T_world_camera, dtype=torch.float64)
    truth = tiny.views(3, seed=1)[1].T_ref_camera
    error = pose_error(SE3.from_matrix(matrix), truth)
    assert result.error is not None
    assert result.error.translation == pytest.approx(float(error.translation), abs=1e-6)


@pytest.mark.slow
def test_the_same_trial_gives_the_same_line_here_and_elsewhere(trial: Trial) -> None:
    first = timeless(run_trial(trial))
    torch.manual_seed(17)
    assert timeless(run_trial(trial)) == first
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        assert timeless(pool.submit(run_trial, trial).result()) == first
    other = run_trial(dataclasses.replace(trial, seed=4))
    assert other.start_error is not None
    assert other.T_world_camera != first.T_world_camera


def test_a_rig_is_judged_by_its_last_camera(trial: Trial) -> None:
    result = run_trial(dataclasses.replace(trial, frames=("t_0000", "t_0002")))
    assert result.frame == "t_0002"
    assert result.trial.frames == ("t_0000", "t_0002")


def test_a_trial_without_depth_is_given_none(trial: Trial, tmp_path: Path) -> None:
    """Whatever the weight of depth: as if the data had none."""
    tiny.write_dataset(tmp_path / "data", depth=False)
    blind = timeless(run_trial(dataclasses.replace(trial, depth=False)))
    bare = timeless(run_trial(dataclasses.replace(trial, data=str(tmp_path / "data"))))
    assert blind.T_world_camera == bare.T_world_camera
    assert blind.T_world_camera != run_trial(trial).T_world_camera


def test_a_trial_that_cannot_be_is_refused(trial: Trial) -> None:
    """Plans refuse most of it before; a trial may come from elsewhere."""
    without: dict[str, Any] = {"protocol": "none", "size": ()}
    wrong: list[tuple[dict[str, Any], str | None, str, str | None]] = [
        ({"protocol": "bit"}, None, "no protocol 'bit', did you mean 'bid'?", None),
        ({"size": ()}, None, "size is missing", "e_t (m)"),
        ({"config": '{"ray": 1}'}, "config", "'ray', did you mean 'rays'?", None),
        ({"config": "{"}, "config", "not JSON", "settings of bid"),
        (without, None, "method 'bid' needs a start", None),
        (without | {"method": "auto", "config": "{}"}, "the map has no surface", "method 'auto'", None),
        ({"method": "magic"}, None, "no method 'magic'", None),
        ({"frames": ("nope",)}, "split 'test'", "no frame 'nope'", "'t_0000'"),
    ]
    for change, where, found, expected in wrong:
        with refused(where=where, found=found, expected=expected):
            run_trial(dataclasses.replace(trial, **change))


def test_a_trace_knows_what_was_not_finite() -> None:
    trace = Trace((1.0, None), (2.0, 3.0)).as_error()
    assert trace.translation.isnan().tolist() == [False, True]


def test_peak_memory_is_of_what_went_on_since() -> None:
    forget_peak_memory()
    before = peak_memory_bytes()
    block = torch.ones(40_000_000)
    assert peak_memory_bytes() >= before + 100_000_000
    del block
    forget_peak_memory()
    assert peak_memory_bytes() < before + 100_000_000
