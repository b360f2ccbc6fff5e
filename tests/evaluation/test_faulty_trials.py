"""Faults in trials and results: they are part of what a trial is."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch

from bidnerf.cli import main
from bidnerf.evaluation import (
    FAULTS,
    NO_FAULT,
    Plan,
    ResultsFile,
    Trial,
    faulty,
    key_of,
    list_trials,
    missing_trials,
)

# Inside: the images of a trial
from bidnerf.evaluation.trial import trial_views
from bidnerf.scenes import closed_form_data
from bidnerf_core.registry import registered
from optional import require
from refusals import refused

pytestmark = pytest.mark.usefixtures("small_images")
QUICK = ["--method", "bid", "--rays", "16", "--max-steps", "2", "--workers", "1", "--size", "0.3"]


def trial(fault: str = NO_FAULT, seed: int = 0) -> Trial:
    return Trial("demo:blobs", "demo:blobs", ("0003",), (), seed, fault)


def trials_of(**options: Any) -> list[Trial]:
    return list_trials(Plan(**options), "demo:blobs", "demo:blobs", closed_form_data("demo:blobs"))


def test_a_plan_tries_each_fault_on_the_same_frames() -> None:
    faults = ("none", "depth-scale:1.02", "exposure:0.7+blur:3")
    trials = trials_of(trials=3, faults=faults)
    assert [t.fault for t in trials] == [fault for fault in faults for _ in range(3)]
    assert len({(t.frames, t.seed) for t in trials}) == 3
    assert len({key_of(t) for t in trials}) == 9
    with refused(found="fault depth-scale:1.02 changes the measured depth, which the method does not receive"):
        trials_of(depth=False, faults=faults)


def test_the_method_gets_the_faulty_views() -> None:
    data = closed_form_data("demo:blobs")
    (clean,), (bad,) = trial_views(trial(), data), trial_views(trial("depth-scale:1.02", 4), data)
    assert torch.equal(require(bad.frame.depth), require(clean.frame.depth) * 1.02)
    (blind,) = trial_views(dataclasses.replace(trial("occluder:0.2"), depth=False), data)
    assert blind.frame.depth is None
    assert torch.equal(blind.frame.rgb, faulty(clean, "occluder:0.2", 0).frame.rgb)


def test_results_notice_when_a_fault_has_changed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["evaluate", "demo:blobs", "--out", str(tmp_path / "r.jsonl"), *QUICK, "--trials", "1"]
    words += ["--fault", "exposure:0.7"]
    assert main(words) == 0
    trials = trials_of(
        protocol="bid",
        sizes=[0.3],
        trials=1,
        method="bid",
        faults=["exposure:0.7"],
        config='{"max_steps": 2, "rays": 16}',
    )
    with ResultsFile(tmp_path / "r.jsonl") as file:
        assert missing_trials(trials, file) == []
        other = dataclasses.replace(FAULTS["exposure"], change=FAULTS["blur"].change)
        monkeypatch.setitem(registered, ("faults", "exposure"), other)
        with refused(where=tmp_path / "r.jsonl", found="made with other images"):
            missing_trials(trials, file)
