"""Input and output: reading files that users name, and writing whole files (text, JSON, images, arrays)."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
