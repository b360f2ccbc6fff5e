"""Carving: where matter can be according to the views alone, before any field is trained. When in doubt,
matter is assumed.
"""

from bidnerf_core.carving.bounds import estimate_bounds
from bidnerf_core.carving.cells import occupied_cells, occupied_voxels
from bidnerf_core.carving.free_space import FreeSpace
from bidnerf_core.carving.hull import has_outline

__all__ = ["FreeSpace", "estimate_bounds", "has_outline", "occupied_cells", "occupied_voxels"]
