"""Conversion of a baked surface and of landmarks to named tensors, for storage, and back."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import astuple
from typing import Any

import torch
from torch import Tensor

from bidnerf_core.fields import VoxelGrid
from bidnerf_core.geometry import SE3
from bidnerf_core.io import COLOUR_ROUNDING, TensorKind, check_tensors, pack_tensors
from bidnerf_core.mapping.landmarks.descriptors import DescriptorCells
from bidnerf_core.mapping.landmarks.landmark_map import HeldOutTrial, LandmarkMap, Tracks
from bidnerf_core.mapping.surface.surface_map import SurfaceMap, Surfels
from bidnerf_core.mapping.surface.surfel_index import CELLS_OF_BLOCK, COARSER_FROM, SurfelIndex, block_shape
from bidnerf_core.settings import LARGEST_LENGTH

TINY = sys.float_info.min  # the least number above 0
SURFELS = ("positions", "normals", "rgb", "rgb_gradient")
SURFACE_KINDS = {
    "positions": TensorKind("N 3", least=-LARGEST_LENGTH, most=LARGEST_LENGTH),
    "normals": TensorKind("N 3", is_unit=True),
    "rgb": TensorKind("N 3", least=-COLOUR_ROUNDING, most=1 + COLOUR_ROUNDING),
    "rgb_gradient": TensorKind("N 3 3"),
    "keyframes": TensorKind("K 4 4", torch.float64),
    "lower": TensorKind("3", torch.float64),
    "cell": TensorKind("", torch.float64, least=TINY),
    "shape": TensorKind("3", torch.int64, least=1, most=2**31),
    "first": TensorKind("X Y Z", torch.int32, least=0),
    "level": TensorKind("X Y Z", torch.uint8, most=len(COARSER_FROM)),
    "entries": TensorKind("e", torch.int32, index_of="N"),
}
LANDMARK_KINDS = {
    "positions": TensorKind("n 3", least=-LARGEST_LENGTH, most=LARGEST_LENGTH),
    "deviations": TensorKind("n 2", least=0, most=LARGEST_LENGTH),
    "descriptors": TensorKind("n D", torch.uint8),
    "directions": TensorKind("n 3", is_unit=True),
    "cones": TensorKind("n", least=0, most=math.pi + 1e-6),
    "sizes": TensorKind("n", least=0, most=LARGEST_LENGTH),
    "views": TensorKind("n", torch.int32, least=1),
    "noise": TensorKind("", torch.float64, least=TINY, most=1e6),
    "pose_covariance": TensorKind("6 6", torch.float64),
    "correlation": TensorKind("", torch.float64, least=TINY, most=1e9),
    "usual_matches": TensorKind("", torch.float64, least=0),
    "calibration_scatter": TensorKind("4", torch.float64, least=TINY, most=1e6),
    "trial": TensorKind("t", torch.float64),  # the fields of ``HeldOutTrial`` in order; earlier versions stored fewer
    "moving": TensorKind("", torch.float64, least=0, most=1),
}
TRACK_KINDS = {
    "track_landmark": TensorKind("m", torch.int32, index_of="n"),
    "track_image": TensorKind("m", torch.int32, least=0),
    "track_pixel": TensorKind("m 2"),
}
"""Optional: earlier versions stored no tracks."""
CELL_KINDS = {
    "cell_centres": TensorKind("C D"),
    "cell": TensorKind("n", torch.int32, index_of="C"),
}
"""Optional: few landmarks have none, and earlier versions stored none."""


def surface_tensors(surface: SurfaceMap) -> dict[str, Tensor]:
    """Return copies of a surface's tensors, by name and in the dtypes of ``SURFACE_KINDS``."""
    index, grid = surface.index, surface.grid
    values: dict[str, Any] = {name: getattr(surface.surfels, name) for name in SURFELS}
    of_grid = {"keyframes": surface.keyframes, "lower": grid.lower, "cell": grid.cell, "shape": grid.shape}
    values |= of_grid | {name: getattr(index, name) for name in ("first", "level", "entries")}
    return _copies(values, SURFACE_KINDS)


def _copies(values: dict[str, Any], kinds: Mapping[str, TensorKind]) -> dict[str, Tensor]:
    return pack_tensors({name: torch.as_tensor(values[name], dtype=kind.dtype) for name, kind in kinds.items()})


def surface_from_tensors(tensors: dict[str, Tensor]) -> SurfaceMap:
    """Return the surface that ``surface_tensors`` converted to ``tensors``.

    Raises ``KeyError`` for a missing tensor, ``ValueError`` for one with the wrong shape, dtype or content.
    """
    check_tensors(tensors, SURFACE_KINDS)
    cell = float(tensors["cell"])
    steepest = 1000 / cell  # in full scales per cell of the grid
    if float(tensors["rgb_gradient"].abs().max()) > steepest:
        raise ValueError(f"rgb_gradient exceeds {steepest:g}")
    if not bool(SE3.from_matrix(tensors["keyframes"]).is_rigid().all()):
        raise ValueError("a keyframe is not a rigid transform")
    # No look-up may read outside the index.
    (x, y, z), (nx, ny, nz) = tensors["lower"].tolist(), tensors["shape"].tolist()
    grid = VoxelGrid((x, y, z), cell, (nx, ny, nz))
    level, first = tensors["level"], tensors["first"]
    if block_shape(grid) != tuple(first.shape):
        raise ValueError(f"first does not have the shape of the blocks of a grid of {grid.shape} cells")
    ends = first.long() + (CELLS_OF_BLOCK >> 3 * level.long())
    if int(ends.max()) > len(tensors["entries"]):
        raise ValueError("first refers to entries that do not exist")
    index = SurfelIndex(grid, first, level, tensors["entries"])
    return SurfaceMap(Surfels(*(tensors[name] for name in SURFELS)), index, tensors["keyframes"])


def landmark_tensors(landmarks: LandmarkMap) -> dict[str, Tensor]:
    """Return copies of the tensors of ``landmarks``, by name and in the dtypes of ``LANDMARK_KINDS``."""
    values = {name: getattr(landmarks, name) for name in LANDMARK_KINDS} | {"trial": astuple(landmarks.trial)}
    copies = _copies(values, LANDMARK_KINDS)
    if (tracks := landmarks.tracks) is not None:
        parts = (tracks.landmark, tracks.image, tracks.pixel)
        copies |= _copies(dict(zip(TRACK_KINDS, parts, strict=True)), TRACK_KINDS)
    if (cells := landmarks.descriptor_cells) is not None:
        copies |= _copies({"cell_centres": cells.centres, "cell": cells.cell}, CELL_KINDS)
    return copies


def landmarks_from_tensors(tensors: dict[str, Tensor]) -> LandmarkMap:
    """Return the landmarks that ``landmark_tensors`` converted to ``tensors``.

    Raises ``KeyError`` for a missing tensor, ``ValueError`` for one with the wrong shape, dtype or content.
    """
    tracks, cells = (kinds if kinds.keys() <= tensors.keys() else {} for kinds in (TRACK_KINDS, CELL_KINDS))
    check_tensors(tensors, LANDMARK_KINDS | tracks | cells)
    covariance = tensors["pose_covariance"]
    if float((covariance - covariance.mT).abs().max()) > 0 or float(torch.linalg.eigvalsh(covariance)[0]) < 0:
        raise ValueError("pose_covariance is not symmetric and positive semidefinite")
    parts: dict[str, Any] = {name: tensors[name] for name in LANDMARK_KINDS}
    parts |= {name: float(tensors[name]) for name in ("noise", "correlation", "usual_matches", "moving")}
    images, localized, *errors = tensors["trial"].tolist()
    parts["trial"] = HeldOutTrial(int(images), int(localized), *errors)
    if tracks:
        parts["tracks"] = Tracks(*(tensors[name] for name in tracks))
    if cells:
        parts["descriptor_cells"] = DescriptorCells(*(tensors[name] for name in cells))
    return LandmarkMap(**parts)
