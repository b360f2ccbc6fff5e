"""AdaNeRF (Kurz et al. 2022): a sampling network picks the few points of a ray at which a shading network is evaluated."""

from bidnerf_adanerf.config import AdaNerfConfig
from bidnerf_adanerf.field import AdaNerfField
from bidnerf_adanerf.recipe import train
from bidnerf_core.backend import RecipeBackend

__all__ = ["AdaNerfConfig", "AdaNerfField", "backend"]

backend = RecipeBackend(
    "AdaNeRF (Kurz et al. 2022): a sampling network picks the few points at which a NeRF is evaluated",
    AdaNerfConfig,
    AdaNerfField,
    train,
)
