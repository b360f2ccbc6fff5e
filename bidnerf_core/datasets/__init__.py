"""Readers and writers of posed images and sequences. All conventions of file formats are converted here."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
