"""The contract of the bundled backends, by name alone: ``.ci/wheels`` runs this outside of the checkout.

Not collected by ``pytest`` in the checkout, where each backend's own tests hold it to the contract with a config of theirs.
"""

from __future__ import annotations

from bidnerf_core.registry import list_plugins
from bidnerf_core.testing import BackendContract

for info in list_plugins("backends"):
    if info.distribution == "bidnerf":
        name = f"Test{info.name.title()}"
        globals()[name] = type(name, (BackendContract,), {"name": info.name})
