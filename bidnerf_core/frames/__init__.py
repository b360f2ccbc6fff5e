"""Frames, the photos they are read from, and the selection of their pixels."""
