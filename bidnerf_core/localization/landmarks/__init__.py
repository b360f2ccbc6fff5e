"""Localization by landmarks: features, matching, an initial pose, its camera, and the evidence for it."""
