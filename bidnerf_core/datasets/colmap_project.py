"""Moved to ``formats``; entry points of earlier installations name this module."""

from bidnerf_core.datasets.formats.colmap import reader as reader
