"""Carving: the space that may be occupied, found from the views alone, before any field is trained.

When in doubt, space counts as occupied.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
