"""Hostile inputs, stops at random moments and crowds, as tests: ``make robustness``. ``counts.py`` prints them as a table."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import pytest
import torch

from counts import KINDS
from findings import FINDINGS, Work
from harness import Check


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


def assert_sound(checks: Iterable[Check]) -> None:
    found = list(checks)
    assert found
    assert [f"{check.name}: {'; '.join(check.wrong)}" for check in found if check.wrong] == []


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Work:
    folder = tmp_path_factory.mktemp("findings")
    folder.chmod(0o755)
    return Work(folder)


@pytest.mark.parametrize("finding", FINDINGS, ids=lambda finding: finding.__name__)
def test_no_finding_is_back(finding, work: Work) -> None:
    assert_sound(finding(work))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "findings"])
def test_hostile_cases_end_soundly(kind: str, tmp_path: Path) -> None:
    assert_sound(KINDS[kind](tmp_path, 0.2))
