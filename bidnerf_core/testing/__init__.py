"""The contracts of third-party parts, as test classes for pytest.

A plugin's whole test is::

    from bidnerf_core.testing import BackendContract

    class TestMine(BackendContract):
        backend = my_package.backend

Readers, methods, detectors and faults have contracts of the same kind; they are named as they are registered::

    class TestMyReader(ReaderContract):
        name, folder = "mine", "a/small/capture"
"""

from __future__ import annotations

from bidnerf_core.testing.contract import BackendContract
from bidnerf_core.testing.image_contracts import FaultContract, FeaturesContract
from bidnerf_core.testing.method_contract import MethodContract
from bidnerf_core.testing.reader_contract import ReaderContract

__all__ = ["BackendContract", "FaultContract", "FeaturesContract", "MethodContract", "ReaderContract"]
