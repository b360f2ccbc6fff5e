"""Solvers, which move poses down any cost."""
