"""The contracts of third-party parts, as test classes for pytest.

A plugin's whole test is::

    from bidnerf_core.testing import BackendContract

    class TestMine(BackendContract):
        backend = my_package.backend

Readers, methods, detectors and faults have contracts of the same kind; they are named as they are registered::

    class TestMyReader(ReaderContract):
        name, folder = "mine", "a/small/capture"
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
