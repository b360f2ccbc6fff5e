"""Data baked from a field and its images: the surface (surfels in a grid) and landmarks (points with descriptors).

``surface`` and ``landmarks`` build and read them; ``geometry`` has the least-squares problems over points seen in images.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
