"""Recorded data, and a checkpoint as nerf-pytorch would write it."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from bidnerf_nerf_pytorch.network import Network, NetworkConfig

torch.set_num_threads(1)

Writer = Callable[..., Path]

SMALL = NetworkConfig(layers=3, width=16, position_frequencies=3, direction_frequencies=2)


@pytest.fixture
def nerf_pytorch_data() -> Path:
    """Checkpoints trained by others."""
    folder = os.environ.get("BIDNERF_DATA")
    if not folder:
        pytest.skip("BIDNERF_DATA is not set")
    if not (Path(folder) / "nerf_pytorch").is_dir():
        pytest.skip("no nerf_pytorch in BIDNERF_DATA")
    return Path(folder)


def contents(config: NetworkConfig = SMALL) -> dict[str, Any]:
    torch.manual_seed(0)
    coarse, fine = Network(config), Network(config)
    optimizer = torch.optim.Adam(nn.ModuleList([coarse, fine]).parameters())
    return {
        "iter": 99,
        "model_coarse_state_dict": coarse.state_dict(),
        "model_fine_state_dict": fine.state_dict(),
        "optimizer_state_dict": optimizer.state_dict(),
        "loss": torch.tensor(0.1, requires_grad=True),
        "psnr": 10.0,
    }


@pytest.fixture
def write(tmp_path: Path) -> Writer:
    """A function that writes a checkpoint, by default a valid one, and returns its path."""

    def writer(found: Any = None, name: str = "checkpoint00099.ckpt") -> Path:
        torch.save(contents() if found is None else found, tmp_path / name)
        return tmp_path / name

    return writer
