"""Poses from points that images see: states of h hypotheses, Levenberg-Marquardt, and robust reprojection errors."""
