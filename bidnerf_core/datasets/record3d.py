"""Moved to ``formats``; entry points of earlier installations name this module."""

from bidnerf_core.datasets.formats.record3d import reader as reader
