"""Structure from motion: cameras and poses for photos and videos that have none, using COLMAP (extra ``sfm``)."""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
