"""Readers for posed images and sequences, and writers. All file-format conventions are converted here."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
