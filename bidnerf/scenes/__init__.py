"""Closed-form scenes with exact colour and depth, for the demo, the tests and the benchmarks."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
