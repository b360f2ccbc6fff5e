"""Carving: where matter can be according to the views alone, before any field is trained. When in doubt,
matter is assumed.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
