"""Data baked from a field and its images: the surface, as surfels in a grid, and landmarks, as points with descriptors."""

from bidnerf_core.mapping.surface.baking import BakeConfig, bake
from bidnerf_core.mapping.surface.surface_map import SurfaceMap
from bidnerf_core.mapping.surface.surfels import Surfels
from bidnerf_core.mapping.tensors import surface_from_tensors, surface_tensors

__all__ = ["BakeConfig", "SurfaceMap", "Surfels", "bake", "surface_from_tensors", "surface_tensors"]
