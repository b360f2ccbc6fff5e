"""The contract of every backend."""

from __future__ import annotations

from bidnerf.testing import BackendContract
from bidnerf_nerfstudio import instant_ngp, nerfacto, vanilla
from bidnerf_nerfstudio.networks import HashConfig

ENCODING = HashConfig(levels=4, log2_table_size=12, base_resolution=4, finest_resolution=32, width=32)
PROPOSAL = HashConfig(levels=3, log2_table_size=10, base_resolution=4, finest_resolution=16, width=16)


class TestNerfacto(BackendContract):
    backend = nerfacto.backend
    config = nerfacto.NerfactoConfig(
        encoding=ENCODING,
        appearance=4,
        colour_width=32,
        proposals=(PROPOSAL,),
        proposal_samples=(24,),
        samples=12,
        spacing="uniform",
        initial_density=1.0,
        steps=60,
        rays_per_step=128,
    )


class TestInstantNgp(BackendContract):
    backend = instant_ngp.backend
    config = instant_ngp.NgpConfig(
        encoding=ENCODING,
        appearance=0,
        colour_width=32,
        initial_density=1.0,
        grid_resolution=16,
        step=0.1,
        steps=60,
        rays_per_step=128,
    )


class TestVanilla(BackendContract):
    backend = vanilla.backend
    config = vanilla.VanillaConfig(
        width=24,
        layers=3,
        colour_width=24,
        coarse_samples=24,
        fine_samples=8,
        steps=60,
        rays_per_step=128,
        learning_rate=5e-3,
    )
