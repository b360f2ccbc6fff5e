"""Closed-form scenes with exact colour and depth, for the demo, the tests and the benchmarks."""
