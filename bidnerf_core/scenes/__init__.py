"""Scenes in closed form, with exact colour and depth: what the demo, the tests and the benches are made of."""
