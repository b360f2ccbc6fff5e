"""Test classes for pytest that check whether plugins fulfil the contracts of their kinds.

A complete test of a backend is::

    from bidnerf.testing import BackendContract

    class TestMine(BackendContract):
        backend = my_package.backend

Contracts for readers, posers, methods, detectors and faults refer to a plugin by its registered name::

    class TestMyReader(ReaderContract):
        name, folder = "mine", "a/small/capture"
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
