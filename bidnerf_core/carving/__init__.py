"""What views already tell of where matter can be, before any field is trained; in doubt there is matter."""

from bidnerf_core.carving.bounds import estimate_bounds
from bidnerf_core.carving.cells import occupied_cells
from bidnerf_core.carving.free_space import FreeSpace

__all__ = ["FreeSpace", "estimate_bounds", "occupied_cells"]
