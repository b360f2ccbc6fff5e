"""Conversion of a baked surface to named tensors, for storage, and back."""

from __future__ import annotations

import torch
from torch import Tensor

from bidnerf_core.mapping.surface_map import SurfaceMap
from bidnerf_core.mapping.surfels import Surfels
from bidnerf_core.se3 import SE3
from bidnerf_core.voxel_grid import VoxelGrid

SURFACE_KINDS = {
    "positions": ((-1, 3), torch.float32),
    "normals": ((-1, 3), torch.float32),
    "rgb": ((-1, 3), torch.float32),
    "rgb_gradient": ((-1, 3, 3), torch.float32),
    "nearest": ((-1, -1, -1), torch.int32),
    "keyframes": ((-1, 4, 4), torch.float64),
    "lower": ((3,), torch.float64),
    "cell": ((), torch.float64),
}
"""Shape (-1: any length) and dtype of each tensor."""


def surface_tensors(surface: SurfaceMap) -> dict[str, Tensor]:
    """Return all that a surface consists of, under the names and in the dtypes of ``SURFACE_KINDS``."""
    parts = surface.surfels
    found = {
        "positions": parts.positions, "normals": parts.normals, "rgb": parts.rgb, "rgb_gradient": parts.rgb_gradient,
        "nearest": surface.nearest_in_cell, "keyframes": surface.keyframes,
        "lower": torch.tensor(surface.grid.lower, dtype=torch.float64),
        "cell": torch.tensor(surface.cell, dtype=torch.float64),
    }  # fmt: skip
    return {name: found[name].to(kind).contiguous().clone() for name, (_, kind) in SURFACE_KINDS.items()}


def surface_from_tensors(tensors: dict[str, Tensor]) -> SurfaceMap:
    """Return the surface that ``surface_tensors`` gave as ``tensors``.

    Raises ``KeyError`` for a missing tensor, ``ValueError`` for one of a wrong shape, dtype or content.
    """
    for name, (shape, kind) in SURFACE_KINDS.items():
        value = tensors[name]
        fits = len(shape) == value.dim() and all(
            a in (-1, b) for a, b in zip(shape, value.shape, strict=True)
        )
        if not fits or value.dtype != kind:
            raise ValueError(f"{name} is {value.dtype} {list(value.shape)}, expected {kind} {list(shape)}")
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise ValueError(f"{name} holds NaN or infinity")
    count, nearest = len(tensors["positions"]), tensors["nearest"]
    if any(len(tensors[name]) != count for name in ("normals", "rgb", "rgb_gradient")) or not count:
        raise ValueError("expected equally many positions, normals and colours of surfels, and at least one")
    if not nearest.numel() or not 0 <= int(nearest.min()) <= int(nearest.max()) < count:
        raise ValueError(f"nearest has indices of surfels that do not exist, expected 0 to {count - 1}")
    if not float(tensors["cell"]) > 0:
        raise ValueError(f"cell is {float(tensors['cell'])}, expected a length")
    if not len(tensors["keyframes"]) or not bool(SE3.from_matrix(tensors["keyframes"]).is_rigid().all()):
        raise ValueError("no keyframe, or one that is not rigid")
    surfels = Surfels(*(tensors[name] for name in ("positions", "normals", "rgb", "rgb_gradient")))
    (x, y, z), (nx, ny, nz) = tensors["lower"].tolist(), nearest.shape
    grid = VoxelGrid((x, y, z), float(tensors["cell"]), (nx, ny, nz))
    return SurfaceMap(surfels, grid, nearest, tensors["keyframes"])
