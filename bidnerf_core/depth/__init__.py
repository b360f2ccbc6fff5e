"""Depth images, the sensors that measure them, and their noise."""
