"""What nerf-pytorch stores in a checkpoint."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from bidnerf_nerf_pytorch.network import Network, NetworkConfig

Writer = Callable[..., Path]

SMALL = NetworkConfig(layers=3, width=16, position_frequencies=3, direction_frequencies=2)


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
