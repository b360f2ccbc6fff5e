"""Radiance fields: the contract, samplers, rendering, and residuals of renderings."""
