"""The answer of a localization: as JSON, in a file, and what its outcome means."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.frames import Frame
from bidnerf_core.geometry import SE3, pose_from_matrix
from bidnerf_core.io import from_plain
from bidnerf_core.localization import Localization, Outcome, Verdict

T = SE3.exp(torch.tensor([0.1, -2.0, 3.0, 0.4, -0.5, 0.6], dtype=torch.float64))
FOUND = Localization(
    T_world_camera=T,
    outcome=Outcome.CONVERGED,
    reason="all is well",
    steps=2,
    seconds=0.25,
    loss=0.125,
    method="bid",
    poses=SE3.stack([T, T, T]),
    losses=torch.tensor([0.5, 0.25], dtype=torch.float64),
    covariance=torch.eye(6, dtype=torch.float64),
)
KEYS = [
    "T_world_camera",
    "converged",
    "outcome",
    "reason",
    "steps",
    "seconds",
    "covariance",
    "loss",
    "method",
    "focal_factor",
    "intrinsics",
    "confidence",
    "unit",
]


def test_the_file_holds_the_answer_to_the_last_digit(tmp_path: Path) -> None:
    FOUND.save(tmp_path / "pose.json")
    stored = json.loads((tmp_path / "pose.json").read_text())
    assert list(stored) == KEYS
    assert stored == FOUND.plain()
    matrix = torch.tensor(stored["T_world_camera"], dtype=torch.float64)
    assert torch.equal(matrix, T.matrix())
    torch.testing.assert_close(pose_from_matrix(matrix, "pose.json").matrix(), T.matrix(), rtol=0, atol=1e-15)
    assert torch.equal(torch.tensor(stored["covariance"], dtype=torch.float64), FOUND.covariance)
    assert (stored["outcome"], stored["converged"], stored["steps"]) == ("converged", True, 2)
    assert list(tmp_path.iterdir()) == [tmp_path / "pose.json"]  # no file is left behind


def test_a_later_rejection_comes_with_its_own_confidence() -> None:
    sure = replace(FOUND, confidence=0.99)
    mirrored = sure.rejected(Verdict(Outcome.MIRRORED, "the mirror image fits better"))
    assert (mirrored.outcome, mirrored.confidence) == (Outcome.MIRRORED, None)
    assert mirrored.reason == "the mirror image fits better; all is well"
    assert sure.rejected(Verdict(Outcome.UNCERTAIN, "too risky", 0.99)).plain()["confidence"] == 0.99


@pytest.mark.parametrize("loss", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_null(loss: float, tmp_path: Path) -> None:
    broken = replace(
        FOUND,
        loss=loss,
        T_world_camera=SE3(T.rotation * torch.nan, T.translation),
        covariance=None,
        outcome=Outcome.DIVERGED,
    )
    broken.save(tmp_path / "pose.json")
    stored = json.loads((tmp_path / "pose.json").read_text())
    assert stored["loss"] is stored["T_world_camera"] is stored["covariance"] is None
    assert (stored["outcome"], stored["converged"]) == ("diverged", False)


@pytest.mark.parametrize("outcome", Outcome)
def test_only_converged_accepts_a_pose(outcome: Outcome) -> None:
    accepted = outcome is Outcome.CONVERGED
    assert replace(FOUND, outcome=outcome).converged == accepted
    assert Verdict(outcome, "why").accepted == accepted
    assert replace(FOUND, outcome=outcome).plain()["outcome"] == outcome.value == str(outcome)


def test_a_frame_is_as_taken_with_the_intrinsics_of_the_answer() -> None:
    given, corrected = Intrinsics.from_focal(90.0, 8, 6), Intrinsics.from_focal(100.0, 8, 6)
    frame = Frame("photo", torch.zeros((6, 8, 3)), given)
    assert FOUND.frame_as_taken(frame) is frame
    taken = replace(FOUND, intrinsics=corrected).frame_as_taken(frame)
    assert taken.intrinsics == corrected
    assert taken.rgb_bytes is frame.rgb_bytes
    assert FOUND.plain()["intrinsics"] is None
    stored = replace(FOUND, intrinsics=corrected).plain()["intrinsics"]
    assert from_plain(Intrinsics, json.loads(json.dumps(stored)), "") == corrected
