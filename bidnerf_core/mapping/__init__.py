"""Data baked from a field and its images: the surface (surfels in a grid) and landmarks (points with descriptors).

``surface`` and ``landmarks`` build and read these data. ``geometry`` estimates the points that images observe, and ``resection`` the
poses of images.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
