"""Moved to ``formats``; entry points of earlier installations name this module."""

from bidnerf_core.datasets.formats.seven_scenes import reader as reader
