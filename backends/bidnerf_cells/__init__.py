"""Fields by cell (as Mega-NeRF, Turki et al. 2022, and Block-NeRF, Tancik et al. 2022): fields of another backend side by side."""

from bidnerf_cells.config import CellsConfig
from bidnerf_cells.field import CellsField
from bidnerf_cells.recipe import CellsBackend

__all__ = ["CellsBackend", "CellsConfig", "CellsField", "backend"]

backend = CellsBackend()
