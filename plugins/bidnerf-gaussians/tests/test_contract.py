"""The contract's tests of the backend."""

from bidnerf.testing import BackendContract
from bidnerf_gaussians import GaussiansConfig


class TestGaussians(BackendContract):
    name = "gaussians"
    config = GaussiansConfig(gaussians=400, steps=40, rays_per_step=256, relocate_every=15, degree=1)
