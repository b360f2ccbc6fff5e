"""The contract, which tests all that is required of a backend. A small config keeps it fast."""

from __future__ import annotations

import bidnerf_template
from bidnerf.testing import BackendContract


class TestTemplate(BackendContract):
    backend = bidnerf_template.backend
    config = bidnerf_template.TemplateConfig(resolution=16, samples=32, steps=40, rays_per_step=512)
