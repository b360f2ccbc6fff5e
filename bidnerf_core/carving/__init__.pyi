from .bounds import estimate_bounds as estimate_bounds
from .bounds import has_outline as has_outline
from .free_space import FreeSpace as FreeSpace
from .free_space import occupied_cells as occupied_cells
from .free_space import occupied_voxels as occupied_voxels
