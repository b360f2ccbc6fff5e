"""Captures: what the images of a map say about its poses, coverage and landmarks."""
