"""Captures: what a map's images reveal about its poses, coverage and landmarks."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
