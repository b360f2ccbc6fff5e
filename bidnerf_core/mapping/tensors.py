"""Conversion of a baked surface and of landmarks to named tensors, for storage, and back."""

from __future__ import annotations

import math
import sys
from dataclasses import astuple
from typing import Any

import torch
from torch import Tensor

from bidnerf_core.fields import LARGEST_LENGTH, VoxelGrid
from bidnerf_core.geometry import SE3
from bidnerf_core.io import COLOUR_ROUNDING
from bidnerf_core.mapping.landmarks.landmark_map import PER_LANDMARK, HeldOutTrial, LandmarkMap, Tracks
from bidnerf_core.mapping.surface.surface_map import SurfaceMap, Surfels
from bidnerf_core.mapping.surface.surfel_index import CELLS_OF_BLOCK, COARSER_FROM, SurfelIndex, block_shape

Kinds = dict[str, tuple[tuple[int, ...], torch.dtype, float, float]]
"""Shape (-1: any length), dtype, and least and largest value of named tensors; larger ones would make later computations overflow."""
TINY, ANY = sys.float_info.min, math.inf
SURFELS = ("positions", "normals", "rgb", "rgb_gradient")
SURFACE_KINDS: Kinds = {
    "positions": ((-1, 3), torch.float32, -LARGEST_LENGTH, LARGEST_LENGTH),
    "normals": ((-1, 3), torch.float32, -ANY, ANY),
    "rgb": ((-1, 3), torch.float32, -COLOUR_ROUNDING, 1 + COLOUR_ROUNDING),
    "rgb_gradient": ((-1, 3, 3), torch.float32, -ANY, ANY),
    "keyframes": ((-1, 4, 4), torch.float64, -ANY, ANY),
    "lower": ((3,), torch.float64, -ANY, ANY),
    "cell": ((), torch.float64, TINY, ANY),
    "shape": ((3,), torch.int64, -ANY, ANY),
    "first": ((-1, -1, -1), torch.int32, -ANY, ANY),
    "level": ((-1, -1, -1), torch.uint8, -ANY, ANY),
    "entries": ((-1,), torch.int32, -ANY, ANY),
}
LANDMARK_KINDS: Kinds = {
    "positions": ((-1, 3), torch.float32, -LARGEST_LENGTH, LARGEST_LENGTH),
    "deviations": ((-1, 2), torch.float32, 0, LARGEST_LENGTH),
    "descriptors": ((-1, -1), torch.uint8, -ANY, ANY),
    "directions": ((-1, 3), torch.float32, -ANY, ANY),
    "cones": ((-1,), torch.float32, 0, math.pi + 1e-6),
    "sizes": ((-1,), torch.float32, 0, LARGEST_LENGTH),
    "views": ((-1,), torch.int32, 1, 2**31),
    "noise": ((), torch.float64, TINY, ANY),
    "pose_covariance": ((6, 6), torch.float64, -ANY, ANY),
    "correlation": ((), torch.float64, TINY, ANY),
    "usual_matches": ((), torch.float64, 0, ANY),
    "calibration_scatter": ((4,), torch.float64, TINY, ANY),
    "trial": ((4,), torch.float64, -ANY, ANY),  # the fields of ``HeldOutTrial`` in order
    "moving": ((), torch.float64, 0, 1),
}
TRACK_KINDS: Kinds = {
    "track_landmark": ((-1,), torch.int32, 0, ANY),
    "track_image": ((-1,), torch.int32, 0, ANY),
    "track_pixel": ((-1, 2), torch.float32, -ANY, ANY),
}
"""Optional: earlier versions stored no tracks."""


def surface_tensors(surface: SurfaceMap) -> dict[str, Tensor]:
    """Return copies of a surface's tensors, by name and in the dtypes of ``SURFACE_KINDS``."""
    index, grid = surface.index, surface.grid
    found: dict[str, Any] = {name: getattr(surface.surfels, name) for name in SURFELS}
    found |= {"keyframes": surface.keyframes, "lower": grid.lower, "cell": grid.cell, "shape": grid.shape}
    found |= {name: getattr(index, name) for name in ("first", "level", "entries")}
    return _copies(found, SURFACE_KINDS)


def _copies(found: dict[str, Any], kinds: Kinds) -> dict[str, Tensor]:
    converted = {name: torch.as_tensor(found[name], dtype=kind) for name, (_, kind, _, _) in kinds.items()}
    return {name: value.contiguous().clone() for name, value in converted.items()}


def surface_from_tensors(tensors: dict[str, Tensor]) -> SurfaceMap:
    """Return the surface that ``surface_tensors`` converted to ``tensors``.

    Raises ``KeyError`` for a missing tensor, ``ValueError`` for one with the wrong shape, dtype or content.
    """
    _check_kinds(tensors, SURFACE_KINDS)
    count = len(tensors["positions"])
    if any(len(tensors[name]) != count for name in SURFELS) or not count:
        raise ValueError("expected as many normals and colours of surfels as positions, and at least one")
    _check_range(tensors, "entries", 0, count - 1)
    cell = float(tensors["cell"])
    _check_range(tensors, "rgb_gradient", -1000 / cell, 1000 / cell)  # in full scales per cell of the grid
    _check_unit_length(tensors, "normals")
    if not len(tensors["keyframes"]) or not bool(SE3.from_matrix(tensors["keyframes"]).is_rigid().all()):
        raise ValueError("keyframes are missing, or one is not a rigid transform")
    # No look-up may read outside the index.
    shape: list[int] = tensors["shape"].tolist()
    if min(shape) < 1 or max(shape) > 2**31:
        raise ValueError(f"shape is {shape}, expected positive numbers of cells")
    (x, y, z), (nx, ny, nz) = tensors["lower"].tolist(), shape
    grid = VoxelGrid((x, y, z), cell, (nx, ny, nz))
    level, first = tensors["level"], tensors["first"]
    if not block_shape(grid) == tuple(level.shape) == tuple(first.shape):
        raise ValueError(f"level and first do not have the shape of the blocks of a grid of {shape} cells")
    if int(level.max()) > len(COARSER_FROM):
        raise ValueError(f"level has a maximum of {int(level.max())}, expected at most {len(COARSER_FROM)}")
    ends = first.long() + (CELLS_OF_BLOCK >> 3 * level.long())
    if int(first.min()) < 0 or int(ends.max()) > len(tensors["entries"]):
        raise ValueError("first refers to entries that do not exist")
    index = SurfelIndex(grid, first, level, tensors["entries"])
    return SurfaceMap(Surfels(*(tensors[name] for name in SURFELS)), index, tensors["keyframes"])


def landmark_tensors(landmarks: LandmarkMap) -> dict[str, Tensor]:
    """Return copies of the tensors of ``landmarks``, by name and in the dtypes of ``LANDMARK_KINDS``."""
    values = {name: getattr(landmarks, name) for name in LANDMARK_KINDS} | {"trial": astuple(landmarks.trial)}
    found = _copies(values, LANDMARK_KINDS)
    if (tracks := landmarks.tracks) is not None:
        parts = (tracks.landmark, tracks.image, tracks.pixel)
        found |= _copies(dict(zip(TRACK_KINDS, parts, strict=True)), TRACK_KINDS)
    return found


def landmarks_from_tensors(tensors: dict[str, Tensor]) -> LandmarkMap:
    """Return the landmarks that ``landmark_tensors`` converted to ``tensors``.

    Raises ``KeyError`` for a missing tensor, ``ValueError`` for one with the wrong shape, dtype or content.
    """
    _check_kinds(tensors, LANDMARK_KINDS)
    count = len(tensors["positions"])
    for name in PER_LANDMARK:
        if len(tensors[name]) != count:
            raise ValueError(f"{name} has {len(tensors[name])} landmarks, positions has {count}")
    if not tensors["descriptors"].shape[1]:
        raise ValueError("descriptors have no channels")
    _check_unit_length(tensors, "directions")
    covariance = tensors["pose_covariance"]
    if float((covariance - covariance.mT).abs().max()) > 0 or float(torch.linalg.eigvalsh(covariance)[0]) < 0:
        raise ValueError("pose_covariance is not symmetric and positive semidefinite")
    parts: dict[str, Any] = {name: tensors[name] for name in LANDMARK_KINDS}
    parts |= {name: float(tensors[name]) for name in ("noise", "correlation", "usual_matches", "moving")}
    images, found, translation, rotation_deg = tensors["trial"].tolist()
    parts["trial"] = HeldOutTrial(int(images), int(found), translation, rotation_deg)
    if TRACK_KINDS.keys() <= tensors.keys():
        _check_kinds(tensors, TRACK_KINDS)
        _check_range(tensors, "track_landmark", 0, count - 1)
        tracks = Tracks(*(tensors[name] for name in TRACK_KINDS))
        if not len(tracks.landmark) == len(tracks.image) == len(tracks.pixel):
            raise ValueError("the tensors of tracks have different lengths")
        parts["tracks"] = tracks
    return LandmarkMap(**parts)


def _check_kinds(tensors: dict[str, Tensor], kinds: Kinds) -> None:
    """Raise ``KeyError`` for a missing tensor, ``ValueError`` for a wrong shape, dtype or range, NaN or infinity."""
    for name, (shape, kind, least, most) in kinds.items():
        value = tensors[name]
        fits = len(shape) == value.dim() and all(
            a in (-1, b) for a, b in zip(shape, value.shape, strict=True)
        )
        if not fits or value.dtype != kind:
            raise ValueError(f"{name} is {value.dtype} {list(value.shape)}, expected {kind} {list(shape)}")
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise ValueError(f"{name} holds NaN or infinity")
        _check_range(tensors, name, least, most)


def _check_range(tensors: dict[str, Tensor], name: str, least: float, most: float) -> None:
    value = tensors[name]
    if value.numel() and not (float(value.min()) >= least and float(value.max()) <= most):
        found = " to ".join(f"{float(end):g}" for end in torch.stack([value.min(), value.max()]).unique())
        expected = "a positive number" if least == TINY else f"{least:g} to {most:g}"
        raise ValueError(f"{name} is {found}, expected {expected}")


def _check_unit_length(tensors: dict[str, Tensor], name: str) -> None:
    length = torch.linalg.vector_norm(tensors[name], dim=-1)
    if length.numel() and float((length - 1).abs().max()) > 1e-3:
        raise ValueError(f"{name} are not of unit length")
