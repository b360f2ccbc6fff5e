"""The contract of the bundled backends, by name alone: ``.ci/wheels`` runs this outside of the checkout.

Not collected by ``pytest`` in the checkout, where each backend's own tests hold it to the contract with a config of theirs.
"""

from __future__ import annotations

from typing import Any

from bidnerf_core.backend import load_backend
from bidnerf_core.io import from_plain
from bidnerf_core.registry import list_plugins
from bidnerf_core.testing import BackendContract

# Networks of a few units: with the defaults, a step takes as long as all steps of these. A small grid for hashgrid too: in the few
# steps of the contract no cell is found empty, and rays must not have more intervals than are sampled where the host may not wait.
CONFIGS: dict[str, dict[str, Any]] = {
    "adanerf": {
        "width": 32, "layers": 2, "position_frequencies": 4, "oracle_width": 32, "oracle_layers": 2, "ray_points": 4,
        "ray_frequencies": 2, "bins": 16, "max_samples": 5, "steps": 60, "samples_per_step": 2048,
        "rays_at_most": 256, "learning_rate": 0.02, "room_resolution": 16,
    },
    "hashgrid": {
        "encoding": {"levels": 3, "log2_table_size": 9, "base_resolution": 4, "finest_resolution": 16}, "width": 16,
        "geometry_features": 3, "grid_resolution": 16, "coarse_levels": 1, "steps": 60, "samples_per_step": 1024,
        "rays_at_most": 256, "learning_rate": 0.05,
    },
    "vanilla": {
        "width": 32, "layers": 2, "skip": 1, "position_frequencies": 4, "coarse_samples": 16, "fine_samples": 8, "steps": 60,
        "samples_per_step": 1024, "rays_at_most": 256, "learning_rate": 0.02, "room_resolution": 16,
    },
}  # fmt: skip

for info in list_plugins("backends"):
    if info.distribution == "bidnerf":
        config = from_plain(load_backend(info.name).config_type, CONFIGS[info.name], info.name)
        attributes = {"name": info.name, "config": config}
        globals()[f"Test{info.name.title()}"] = type(
            f"Test{info.name.title()}", (BackendContract,), attributes
        )
