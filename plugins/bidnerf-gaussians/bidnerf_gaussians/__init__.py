"""Gaussian splats: imports splats trained elsewhere, or trains them on rays."""

from bidnerf_core.backend import RecipeBackend
from bidnerf_gaussians.field import GaussiansField
from bidnerf_gaussians.formats import read_gaussians, write_gaussians
from bidnerf_gaussians.gaussians import Gaussians
from bidnerf_gaussians.importer import GaussiansImporter, importer
from bidnerf_gaussians.recipe import GaussiansConfig, train

__all__ = [
    "Gaussians",
    "GaussiansConfig",
    "GaussiansField",
    "GaussiansImporter",
    "backend",
    "importer",
    "read_gaussians",
    "write_gaussians",
]

backend = RecipeBackend(
    "Gaussian splats: reads what others trained, or trains them on rays",
    GaussiansConfig,
    GaussiansField,
    train,
    GaussiansConfig(gaussians=6000, steps=1500),
)
