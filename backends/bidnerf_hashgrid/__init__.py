"""Multiresolution hash grid with an occupancy grid (Instant-NGP, Mueller et al. 2022), in pure torch."""

from bidnerf_core.backend import RecipeBackend
from bidnerf_hashgrid.field import HashGridField
from bidnerf_hashgrid.recipe import HashGridConfig, train

__all__ = ["HashGridConfig", "HashGridField", "backend"]

backend = RecipeBackend(
    "multiresolution hash grid with an occupancy grid (Instant-NGP), pure torch",
    HashGridConfig,
    HashGridField,
    train,
    # For small, simple scenes: about a minute on two cores.
    quick=HashGridConfig(steps=800, colour_layers=1, coarse_every=8),
)
