"""A recorded scan fulfils the contract of readers: axes and depth unit agree with the photos."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bidnerf_core.testing import ReaderContract

DATA = os.environ.get("BIDNERF_DATA")


@pytest.mark.skipif(DATA is None, reason="BIDNERF_DATA is not set")
class TestScan(ReaderContract):
    name, folder = "scanner-app", Path(DATA or "") / "iphone_corridor"
