"""The surface that a field shows: baked once from any field, asked for the nearest piece of it in constant time."""

from bidnerf_core.surface.baking import BakeConfig, bake
from bidnerf_core.surface.surface_map import SurfaceMap
from bidnerf_core.surface.surfels import Surfels
from bidnerf_core.surface.tensors import surface_from_tensors, surface_tensors

__all__ = ["BakeConfig", "SurfaceMap", "Surfels", "bake", "surface_from_tensors", "surface_tensors"]
