"""Estimation of the points that images observe: triangulation, and bundle adjustment of points and poses together."""
