"""The contract of every backend."""

from __future__ import annotations

import bidnerf_nerf_pytorch
from bidnerf.testing import BackendContract


class TestNerfPytorch(BackendContract):
    backend = bidnerf_nerf_pytorch.backend
    config = bidnerf_nerf_pytorch.NerfPytorchConfig(
        layers=3,
        width=32,
        skips=(1,),
        position_frequencies=4,
        direction_frequencies=1,
        coarse_samples=24,
        fine_samples=8,
        steps=60,
        rays_per_step=128,
    )
