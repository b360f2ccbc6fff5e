"""The contract of backends as a test class for pytest.

A plugin's whole test is::

    from bidnerf_core.testing import BackendContract

    class TestMine(BackendContract):
        backend = my_package.backend
"""

from __future__ import annotations

from bidnerf_core.testing.contract import BackendContract

__all__ = ["BackendContract"]
