"""Captures: what a map's images reveal about its poses, coverage and landmarks."""
