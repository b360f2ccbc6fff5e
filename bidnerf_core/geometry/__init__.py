"""Rigid transforms, similarities and robust statistics."""
