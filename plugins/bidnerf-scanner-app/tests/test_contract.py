"""A recorded scan fulfils the contract of readers: axes and depth unit agree with the photos."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bidnerf.testing import ReaderContract

DATA = os.environ.get("BIDNERF_DATA")


@pytest.fixture(scope="session")
def beginning(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 48 frames of a recorded scan, of which every third has a photo."""
    folder = tmp_path_factory.mktemp("scan")
    for number in range(48):
        for file in (Path(DATA or "") / "iphone_corridor").glob(f"*_{number:05d}.*"):
            (folder / file.name).symlink_to(file)
    return folder


@pytest.mark.skipif(DATA is None, reason="BIDNERF_DATA is not set")
class TestScan(ReaderContract):
    name = "scanner-app"

    @pytest.fixture(autouse=True)
    def _folder(self, beginning: Path) -> None:
        type(self).folder = beginning
