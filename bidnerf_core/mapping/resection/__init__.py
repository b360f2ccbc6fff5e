"""Poses from known points: the unknowns of many hypotheses, reprojection errors, and their minimization, for maps and queries."""
