"""The contract of the bundled backends, by name alone: ``.ci/wheels`` runs this outside of the checkout.

Not collected by ``pytest`` in the checkout, where each backend's own tests hold it to the contract with a config of theirs.
"""

from __future__ import annotations

from typing import Any

from bidnerf_core.backend import load_backend
from bidnerf_core.registry import list_plugins
from bidnerf_core.testing import BackendContract

# The few steps of the contract find no cell of the occupancy grid empty. With fewer cells, rays still have no more intervals
# than are sampled on a device for which the host does not wait.
CHANGES: dict[str, dict[str, Any]] = {"hashgrid": {"grid_resolution": 32, "steps": 40}}

for info in list_plugins("backends"):
    if info.distribution == "bidnerf":
        name, attributes = f"Test{info.name.title()}", {"name": info.name}
        if info.name in CHANGES:
            attributes["config"] = load_backend(info.name).config_type(**CHANGES[info.name])
        globals()[name] = type(name, (BackendContract,), attributes)
