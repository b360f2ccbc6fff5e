"""Moved to ``formats``; entry points of earlier installations name this module."""

from bidnerf_core.datasets.formats.stray_scanner import reader as reader
