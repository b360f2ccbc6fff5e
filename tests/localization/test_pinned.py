"""All five methods answer as they did when ``pinned/blobs.json`` was recorded, before localization was rebuilt.

The record was made by the code of that time with ``pinned_poses.py``'s settings, on one thread. What may differ:
rounding, in another order of sums or on another processor, within the tolerance; and covariances, which are not pinned, since
those of noise-free scenes are the covariance of rounding errors. Since then only ``auto`` has another record: the surface's
cells became finer, depth is refined against the surface and the field together, which moved its answers by up to 5e-4, and the
exposure is estimated with depth as well, which moved those with depth by up to 2e-3, from 1 to 3 mm off in this scene of
unchanged exposure, and before a plain background, which moved those by colour by up to 2e-4; the search by images fits the exposure in
more rounds, which moved them by 4e-5.
A change of a method that is meant to change its answers
needs a new record (``python tests/localization/pinned_poses.py record``) and a word on why.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path

import pytest

import pinned_poses

HERE = Path(__file__).parent
RECORD = json.loads((HERE / "pinned" / "blobs.json").read_text())


@functools.cache
def all_cases():
    return {case.name: case for case in pinned_poses.cases(pinned_poses.blobs())}


SEARCHED = ("blobs/one/rgb/auto/none", "blobs/rig/rgb/auto/none")
"""Cases of a search by colour among hundreds of poses. Which of nearly equal hypotheses are kept depends on rounding, and with it
the number of steps: an Intel processor takes 40 for the 41 of the AMD one of the record, and ends 9.3e-5 away.
"""
SEARCH_TOLERANCE = 3e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in RECORD if name not in SEARCHED])
def test_the_answer_is_the_recorded_one(name: str) -> None:
    found = pinned_poses.row(all_cases()[name].run())
    assert pinned_poses.differences(RECORD[name], found) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", SEARCHED)
def test_the_answer_of_a_search_is_about_the_recorded_one(name: str) -> None:
    found = pinned_poses.row(all_cases()[name].run())
    known = RECORD[name]
    assert pinned_poses.differences(known, {**found, "steps": known["steps"]}, SEARCH_TOLERANCE) == []
    assert abs(found["steps"] - known["steps"]) <= 5


def test_every_case_is_recorded() -> None:
    assert set(RECORD) == set(all_cases())


def test_a_different_answer_is_noticed() -> None:
    one = next(iter(RECORD.values()))
    moved = [[x + 2e-5 for x in line] for line in one["T"]]
    assert pinned_poses.differences(one, {**one, "T": moved}) == ["pose off by 2.0e-05"]
    assert pinned_poses.differences(one, {**one, "loss": float("nan")}) == ["loss off by nan"]
    assert len(pinned_poses.differences(one, {**one, "converged": not one["converged"], "steps": -1})) == 2
