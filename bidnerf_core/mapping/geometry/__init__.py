"""Geometry of points seen in images: reprojection errors and their derivatives, resection, triangulation, bundle adjustment."""
