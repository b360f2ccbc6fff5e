"""Whether the examples are what bidnerf asks of their kinds; the tests come with bidnerf."""

from __future__ import annotations

from pathlib import Path

import pytest

from bidnerf.testing import FaultContract, FeaturesContract, MethodContract, ReaderContract


class TestReader(ReaderContract):
    name = "pose-table"

    @pytest.fixture(autouse=True)
    def _folder(self, capture: Path) -> None:
        type(self).folder = capture


class TestMethod(MethodContract):
    name = "landmarks-alone"


class TestDetector(FeaturesContract):
    name = "orb"


class TestFault(FaultContract):
    name = "stripes"
