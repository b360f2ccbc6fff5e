"""Readers of research datasets and of the files that capture apps write; each is an entry point of ``bidnerf.readers``."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
