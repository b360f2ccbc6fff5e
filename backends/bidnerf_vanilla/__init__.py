"""NeRF (Mildenhall et al. 2020): a coarse and a fine MLP with hierarchical sampling."""

from bidnerf_core.backend import RecipeBackend
from bidnerf_vanilla.field import VanillaField
from bidnerf_vanilla.recipe import VanillaConfig, train

__all__ = ["VanillaConfig", "VanillaField", "backend"]

backend = RecipeBackend(
    "NeRF (Mildenhall et al. 2020): a coarse and a fine MLP with hierarchical sampling",
    VanillaConfig,
    VanillaField,
    train,
)
