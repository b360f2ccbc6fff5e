"""Conversion of a baked surface and of landmarks to named tensors, for storage, and back."""

from __future__ import annotations

import math
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

Kinds = dict[str, tuple[tuple[int, ...], torch.dtype]]
"""Shape (-1: any length) and dtype of named tensors."""
STEEPEST = 1000.0
"""Limit of a surfel's colour gradient, in full scales per cell of the grid."""
SURFACE_KINDS: Kinds = {
    "positions": ((-1, 3), torch.float32),
    "normals": ((-1, 3), torch.float32),
    "rgb": ((-1, 3), torch.float32),
    "rgb_gradient": ((-1, 3, 3), torch.float32),
    "keyframes": ((-1, 4, 4), torch.float64),
    "lower": ((3,), torch.float64),
    "cell": ((), torch.float64),
}
INDEX_KINDS: Kinds = {
    "shape": ((3,), torch.int64),
    "first": ((-1, -1, -1), torch.int32),
    "level": ((-1, -1, -1), torch.uint8),
    "entries": ((-1,), torch.int32),
}
LANDMARK_KINDS: Kinds = {
    "positions": ((-1, 3), torch.float32),
    "deviations": ((-1, 2), torch.float32),
    "descriptors": ((-1, -1), torch.uint8),
    "directions": ((-1, 3), torch.float32),
    "cones": ((-1,), torch.float32),
    "sizes": ((-1,), torch.float32),
    "views": ((-1,), torch.int32),
    "noise": ((), torch.float64),
    "pose_covariance": ((6, 6), torch.float64),
    "correlation": ((), torch.float64),
    "usual_matches": ((), torch.float64),
    "calibration_scatter": ((4,), torch.float64),
    "trial": ((4,), torch.float64),  # the fields of ``HeldOutTrial`` in order
    "moving": ((), torch.float64),
}
TRACK_KINDS: Kinds = {
    "track_landmark": ((-1,), torch.int32),
    "track_image": ((-1,), torch.int32),
    "track_pixel": ((-1, 2), torch.float32),
}
"""Optional: earlier versions stored no tracks."""


def surface_tensors(surface: SurfaceMap) -> dict[str, Tensor]:
    """Return copies of a surface's tensors, by name and in the dtypes of ``SURFACE_KINDS`` and ``INDEX_KINDS``."""
    parts, index = surface.surfels, surface.index
    found = {
        "positions": parts.positions, "normals": parts.normals, "rgb": parts.rgb, "rgb_gradient": parts.rgb_gradient,
        "keyframes": surface.keyframes,
        "lower": torch.tensor(surface.grid.lower, dtype=torch.float64),
        "cell": torch.tensor(surface.cell, dtype=torch.float64),
        "shape": torch.tensor(surface.grid.shape),
        "first": index.first, "level": index.level, "entries": index.entries,
    }  # fmt: skip
    kinds = SURFACE_KINDS | INDEX_KINDS
    return {name: found[name].to(kind).contiguous().clone() for name, (_, kind) in kinds.items()}


def surface_from_tensors(tensors: dict[str, Tensor]) -> SurfaceMap:
    """Return the surface that ``surface_tensors`` converted to ``tensors``.

    Raises ``KeyError`` for a missing tensor, ``ValueError`` for one with the wrong shape, dtype or content.
    """
    check_kinds(tensors, SURFACE_KINDS | INDEX_KINDS)
    count = len(tensors["positions"])
    if any(len(tensors[name]) != count for name in ("normals", "rgb", "rgb_gradient")) or not count:
        raise ValueError("expected as many normals and colours of surfels as positions, and at least one")
    entries = tensors["entries"]
    if not entries.numel() or not 0 <= int(entries.min()) <= int(entries.max()) < count:
        raise ValueError(f"entries refers to surfels that do not exist, expected 0 to {count - 1}")
    if not float(tensors["cell"]) > 0:
        raise ValueError(f"cell is {float(tensors['cell'])}, expected a positive length")
    check_range(tensors, "positions", -LARGEST_LENGTH, LARGEST_LENGTH)
    check_range(tensors, "rgb", -COLOUR_ROUNDING, 1 + COLOUR_ROUNDING)
    steepest = STEEPEST / float(tensors["cell"])
    check_range(tensors, "rgb_gradient", -steepest, steepest)
    check_unit_length(tensors, "normals")
    if not len(tensors["keyframes"]) or not bool(SE3.from_matrix(tensors["keyframes"]).is_rigid().all()):
        raise ValueError("keyframes are missing, or one is not a rigid transform")
    surfels = Surfels(*(tensors[name] for name in ("positions", "normals", "rgb", "rgb_gradient")))
    return SurfaceMap(surfels, _index(tensors), tensors["keyframes"])


def check_kinds(tensors: dict[str, Tensor], kinds: Kinds) -> None:
    """Raise ``KeyError`` for a missing tensor, ``ValueError`` for a wrong shape or dtype, NaN or infinity."""
    for name, (shape, kind) in kinds.items():
        value = tensors[name]
        fits = len(shape) == value.dim() and all(
            a in (-1, b) for a, b in zip(shape, value.shape, strict=True)
        )
        if not fits or value.dtype != kind:
            raise ValueError(f"{name} is {value.dtype} {list(value.shape)}, expected {kind} {list(shape)}")
        if value.is_floating_point() and not bool(value.isfinite().all()):
            raise ValueError(f"{name} holds NaN or infinity")


def check_range(tensors: dict[str, Tensor], name: str, least: float, most: float) -> None:
    """Raise ``ValueError`` for values outside ``least`` to ``most``, which would make later computations overflow."""
    value = tensors[name]
    if value.numel() and not (float(value.min()) >= least and float(value.max()) <= most):
        raise ValueError(
            f"{name} is {float(value.min()):g} to {float(value.max()):g}, expected {least:g} to {most:g}"
        )


def check_unit_length(tensors: dict[str, Tensor], name: str) -> None:
    """Raise ``ValueError`` for vectors that are not of unit length, up to rounding."""
    length = torch.linalg.vector_norm(tensors[name], dim=-1)
    if length.numel() and float((length - 1).abs().max()) > 1e-3:
        raise ValueError(f"{name} are not of unit length")


def _index(tensors: dict[str, Tensor]) -> SurfelIndex:
    """Return the index, after checking that no look-up reads outside it."""
    shape: list[int] = tensors["shape"].tolist()
    if min(shape) < 1 or max(shape) > 2**31:
        raise ValueError(f"shape is {shape}, expected positive numbers of cells")
    (x, y, z), (nx, ny, nz) = tensors["lower"].tolist(), shape
    grid = VoxelGrid((x, y, z), float(tensors["cell"]), (nx, ny, nz))
    level, first = tensors["level"], tensors["first"]
    if not block_shape(grid) == tuple(level.shape) == tuple(first.shape):
        raise ValueError(f"level and first do not have the shape of the blocks of a grid of {shape} cells")
    if int(level.max()) > len(COARSER_FROM):
        raise ValueError(f"level has a maximum of {int(level.max())}, expected at most {len(COARSER_FROM)}")
    ends = first.long() + (CELLS_OF_BLOCK >> 3 * level.long())
    if int(first.min()) < 0 or int(ends.max()) > len(tensors["entries"]):
        raise ValueError("first refers to entries that do not exist")
    return SurfelIndex(grid, first, level, tensors["entries"])


def landmark_tensors(landmarks: LandmarkMap) -> dict[str, Tensor]:
    """Return copies of the tensors of ``landmarks``, by name and in the dtypes of ``LANDMARK_KINDS``."""
    values = {name: getattr(landmarks, name) for name in LANDMARK_KINDS} | {"trial": astuple(landmarks.trial)}
    found = {name: torch.as_tensor(values[name], dtype=kind) for name, (_, kind) in LANDMARK_KINDS.items()}
    if (tracks := landmarks.tracks) is not None:
        found |= dict(zip(TRACK_KINDS, (tracks.landmark, tracks.image, tracks.pixel), strict=True))
    return {name: value.contiguous().clone() for name, value in found.items()}


def landmarks_from_tensors(tensors: dict[str, Tensor]) -> LandmarkMap:
    """Return the landmarks that ``landmark_tensors`` converted to ``tensors``.

    Raises ``KeyError`` for a missing tensor, ``ValueError`` for one with the wrong shape, dtype or content.
    """
    check_kinds(tensors, LANDMARK_KINDS)
    _check_contents(tensors)
    parts: dict[str, Any] = {name: tensors[name] for name in LANDMARK_KINDS}
    parts |= {name: float(tensors[name]) for name in ("noise", "correlation", "usual_matches", "moving")}
    images, found, translation, rotation_deg = tensors["trial"].tolist()
    parts["trial"] = HeldOutTrial(int(images), int(found), translation, rotation_deg)
    if TRACK_KINDS.keys() <= tensors.keys():
        check_kinds(tensors, TRACK_KINDS)
        check_range(tensors, "track_landmark", 0, len(tensors["positions"]) - 1)
        check_range(tensors, "track_image", 0, 2**31)
        tracks = Tracks(*(tensors[name] for name in TRACK_KINDS))
        if not len(tracks.landmark) == len(tracks.image) == len(tracks.pixel):
            raise ValueError("the tensors of tracks have different lengths")
        parts["tracks"] = tracks
    return LandmarkMap(**parts)


def _check_contents(tensors: dict[str, Tensor]) -> None:
    count = len(tensors["positions"])
    for name in PER_LANDMARK:
        if len(tensors[name]) != count:
            raise ValueError(f"{name} has {len(tensors[name])} landmarks, positions has {count}")
    if not tensors["descriptors"].shape[1]:
        raise ValueError("descriptors have no channels")
    if not float(tensors["noise"]) > 0:
        raise ValueError(f"noise is {float(tensors['noise'])}, expected a positive number of pixels")
    if not float(tensors["correlation"]) > 0:
        raise ValueError(f"correlation is {float(tensors['correlation'])}, expected a positive number")
    if not float(tensors["usual_matches"]) >= 0:
        raise ValueError(f"usual_matches is {float(tensors['usual_matches'])}, expected 0 or more")
    if not 0 <= float(tensors["moving"]) <= 1:
        raise ValueError(f"moving is {float(tensors['moving'])}, expected a fraction of the images, 0 to 1")
    if not bool((tensors["calibration_scatter"] > 0).all()):
        raise ValueError(
            f"calibration_scatter is {tensors['calibration_scatter'].tolist()}, expected positive values"
        )
    check_range(tensors, "positions", -LARGEST_LENGTH, LARGEST_LENGTH)
    check_range(tensors, "deviations", 0.0, LARGEST_LENGTH)
    check_range(tensors, "sizes", 0.0, LARGEST_LENGTH)
    check_range(tensors, "cones", 0.0, math.pi + 1e-6)
    check_range(tensors, "views", 1, 2**31)
    check_unit_length(tensors, "directions")
    covariance = tensors["pose_covariance"]
    if float((covariance - covariance.mT).abs().max()) > 0 or float(torch.linalg.eigvalsh(covariance)[0]) < 0:
        raise ValueError("pose_covariance is not symmetric and positive semidefinite")
