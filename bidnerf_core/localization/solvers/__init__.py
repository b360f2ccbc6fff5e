"""Solvers that minimize any cost of poses."""
