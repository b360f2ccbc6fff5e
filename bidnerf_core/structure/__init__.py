"""Structure from motion: cameras and poses for photos and videos without any, using COLMAP (extra ``sfm``)."""
