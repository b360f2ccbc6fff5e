"""What is baked beside a field: its surface, as surfels with a grid that finds the nearest one in constant time."""

from bidnerf_core.mapping.baking import BakeConfig, bake
from bidnerf_core.mapping.surface_map import SurfaceMap
from bidnerf_core.mapping.surfels import Surfels
from bidnerf_core.mapping.tensors import surface_from_tensors, surface_tensors

__all__ = ["BakeConfig", "SurfaceMap", "Surfels", "bake", "surface_from_tensors", "surface_tensors"]
