"""Cameras: intrinsics, where they come from, orientation, and rolling shutters."""
