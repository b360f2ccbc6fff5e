"""Data baked from a field and its images: the surface (surfels in a grid) and landmarks (points with descriptors).

``surface`` and ``landmarks`` build and read them. ``geometry`` estimates points that images see, and ``resection`` the images' poses.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
