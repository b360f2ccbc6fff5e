"""Localization by landmarks: features, matches, a first pose, its camera, and the evidence for it."""
