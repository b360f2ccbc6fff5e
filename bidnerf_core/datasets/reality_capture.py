"""Moved to ``formats``; entry points of earlier installations name this module."""

from bidnerf_core.datasets.formats.reality_capture import reader as reader
