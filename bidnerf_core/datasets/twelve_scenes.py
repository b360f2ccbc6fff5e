"""Moved to ``formats``; entry points of earlier installations name this module."""

from bidnerf_core.datasets.formats.twelve_scenes import reader as reader
