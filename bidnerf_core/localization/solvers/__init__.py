"""Solvers: how poses move, whatever the cost."""
