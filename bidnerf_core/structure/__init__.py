"""Structure from motion: the cameras and poses of photos and videos that come without any, by COLMAP (extra ``sfm``)."""
