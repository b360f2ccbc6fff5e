"""The contract's tests of the backend."""

from bidnerf.testing import BackendContract
from bidnerf_scan import ScanConfig


class TestScan(BackendContract):
    name = "scan"
    config = ScanConfig(pieces=400, steps=40, rays_per_step=256)
