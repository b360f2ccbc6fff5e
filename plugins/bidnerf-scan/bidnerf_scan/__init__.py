"""Meshes and point clouds as maps."""

from bidnerf_core.backend import RecipeBackend
from bidnerf_scan.field import ScanField
from bidnerf_scan.formats import read_scan
from bidnerf_scan.importer import ScanImporter, importer
from bidnerf_scan.meshing import Mesh, mesh_of_surface
from bidnerf_scan.recipe import ScanConfig, train
from bidnerf_scan.scan import Scan

__all__ = [
    "Mesh",
    "Scan",
    "ScanConfig",
    "ScanField",
    "ScanImporter",
    "backend",
    "importer",
    "mesh_of_surface",
    "read_scan",
]

backend = RecipeBackend(
    "scanned meshes and point clouds, or discs on measured depth",
    ScanConfig,
    ScanField,
    train,
    ScanConfig(pieces=6000, steps=300),
)
"""Scanned meshes and point clouds, or discs on measured depth."""
