"""These tests take many minutes: they are collected only where they are asked for, as ``make robustness`` does."""

from __future__ import annotations

from pathlib import Path

import pytest


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return None if any("robustness" in argument for argument in config.args) else True
