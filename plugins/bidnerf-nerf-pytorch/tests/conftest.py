"""Recorded data, and a checkpoint as nerf-pytorch would write it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch

from checkpoints import Writer, contents

torch.set_num_threads(1)


@pytest.fixture
def nerf_pytorch_data() -> Path:
    """Checkpoints trained by others."""
    folder = os.environ.get("BIDNERF_DATA")
    if not folder:
        pytest.skip("BIDNERF_DATA is not set")
    if not (Path(folder) / "nerf_pytorch").is_dir():
        pytest.skip("no nerf_pytorch in BIDNERF_DATA")
    return Path(folder)


@pytest.fixture
def write(tmp_path: Path) -> Writer:
    """A function that writes a checkpoint, by default a valid one, and returns its path."""

    def writer(found: Any = None, name: str = "checkpoint00099.ckpt") -> Path:
        torch.save(contents() if found is None else found, tmp_path / name)
        return tmp_path / name

    return writer
