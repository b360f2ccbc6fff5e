"""PLY files of splats: the layouts of the original 3DGS and 2DGS codes, and PlayCanvas's compressed one."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.io import PlyHeader, read_ply, read_ply_header, write_file
from bidnerf_gaussians.formats.parts import gaussians_of, logit, smallest_three
from bidnerf_gaussians.gaussians import COEFFICIENTS, Gaussians
from bidnerf_gaussians.spherical_harmonics import C0

EXPECTED = "a PLY file of Gaussians"
MEANS, SCALES, TURNS = ("x", "y", "z"), ("scale_0", "scale_1", "scale_2"), tuple(f"rot_{i}" for i in range(4))
COLOUR = tuple(f"f_dc_{i}" for i in range(3))
NEEDED = (*MEANS, *COLOUR, "opacity", *SCALES, *TURNS)
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
DISC = math.log(1e-3)
"""Logarithm of the thickness given to a disc of 2D Gaussian Splatting, relative to its shorter axis."""
CHUNK = 256
"""Number of Gaussians that share a range in a compressed file."""
DEGREES = {3 * (count - 1): degree for degree, count in COEFFICIENTS.items()}
"""Degree of the harmonics by the number of properties ``f_rest_N``."""


def recognises(path: Path) -> bool:
    """Return whether the file is a PLY with the properties of the original 3DGS code."""
    header = _header(path)
    vertex = None if header is None else header.elements.get("vertex")
    return vertex is not None and {"opacity", "scale_0", "rot_0"} <= {
        name.removeprefix("scalar_") for name in vertex.properties
    }


def recognises_discs(path: Path) -> bool:
    """Return whether the file is a PLY of 2D Gaussian Splatting (Huang et al. 2024), whose splats have two scales."""
    header = _header(path) if recognises(path) else None
    vertex = None if header is None else header.elements.get("vertex")
    return vertex is not None and "scale_1" in vertex.properties and "scale_2" not in vertex.properties


def recognises_compressed(path: Path) -> bool:
    """Return whether the file is a compressed PlayCanvas PLY."""
    header = _header(path)
    vertex = None if header is None else header.elements.get("vertex")
    return vertex is not None and "packed_position" in vertex.properties


def _header(path: Path) -> PlyHeader | None:
    if path.suffix.lower() != ".ply" or not path.is_file():
        return None
    try:
        return read_ply_header(path)
    except InputError:
        return None


def read(path: Path) -> Gaussians:
    """Read the Gaussians of a PLY: log scales, logits of the opacities, quaternions w, x, y, z.

    Those with two scales are discs, whose normal is their third axis.
    """
    vertices = _vertices(read_ply(path, EXPECTED), path)
    names = vertices.dtype.names or ()
    if any(name.startswith("scalar_") for name in names):  # as CloudCompare calls the properties that it keeps
        vertices = vertices.view([(name.removeprefix("scalar_"), vertices.dtype[name]) for name in names])
        names = vertices.dtype.names or ()
    missing = [name for name in NEEDED if name not in names and name != "scale_2"]
    if missing:
        raise InputError(f"has no property {', '.join(missing)}", where=path, expected=EXPECTED)
    if moving := next((name for name in names if name.startswith(("motion_", "trbf_", "omega_"))), None):
        raise InputError(f"has {moving}: its splats move", where=path, expected="a scene at rest")
    rest = sum(name.startswith("f_rest_") for name in names)
    harmonics = _columns(vertices, COLOUR)[:, None]
    if rest:
        harmonics = np.concatenate([harmonics, _rest(vertices, rest, path)], axis=1)
    scales = _columns(vertices, SCALES if "scale_2" in names else SCALES[:2])
    if scales.shape[1] == 2:
        scales = np.concatenate([scales, scales.min(axis=1, keepdims=True) + np.float32(DISC)], axis=1)
    opacity = vertices["opacity"]
    if "filter_3D" in names:  # of Mip-Splatting: convolved with a Gaussian, whose integral stays the same
        wider = 0.5 * np.logaddexp(2 * scales, 2 * np.log(_columns(vertices, ("filter_3D",)).clip(1e-20)))
        share = np.exp((scales - wider).sum(axis=1)) / (1 + np.exp(-opacity.astype(np.float64)))
        scales, opacity = wider.astype(np.float32), logit(share).astype(np.float32)
    return gaussians_of(_columns(vertices, MEANS), scales, _columns(vertices, TURNS), opacity, harmonics)


def _vertices(elements: Mapping[str, np.ndarray], path: Path) -> np.ndarray:
    if "vertex" not in elements:
        raise InputError("has lists of numbers in or before its vertices", where=path, expected=EXPECTED)
    return elements["vertex"]


def _rest(rows: np.ndarray, count: int, path: Path) -> np.ndarray:
    """Return the harmonics (n k 3) above degree 0, which are stored channel by channel."""
    if count not in DEGREES or any(f"f_rest_{i}" not in (rows.dtype.names or ()) for i in range(count)):
        raise InputError(
            f"has {count} properties f_rest_N",
            where=path,
            expected="0, 9, 24 or 45 (degree 0 to 3 of the harmonics)",
        )
    return _columns(rows, tuple(f"f_rest_{i}" for i in range(count))).reshape(len(rows), 3, -1).swapaxes(1, 2)


def _columns(rows: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    return np.stack([rows[name].astype(np.float32) for name in names], axis=-1)


def write(path: Path, gaussians: Gaussians) -> None:
    """Write a PLY file in the layout of the original 3DGS code."""
    count = gaussians.harmonics.shape[1] - 1
    rest = gaussians.harmonics[:, 1:].mT.reshape(len(gaussians), -1)
    names = (*MEANS, "nx", "ny", "nz", *COLOUR, *(f"f_rest_{i}" for i in range(3 * count)), "opacity", *SCALES, *TURNS)
    columns = torch.cat(
        [
            gaussians.means,
            torch.zeros_like(gaussians.means),
            gaussians.harmonics[:, 0],
            rest,
            gaussians.logits[:, None],
            gaussians.log_scales,
            gaussians.quaternions,
        ],
        dim=-1,
    )
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(gaussians)}"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    write_file(path, "\n".join(header).encode() + columns.cpu().numpy().astype("<f4").tobytes())


def read_compressed(path: Path) -> Gaussians:
    """Read the Gaussians of a compressed PLY: numbers with a few bits, within the range of their chunk."""
    elements = read_ply(path, EXPECTED)
    vertices, chunks = _vertices(elements, path), elements.get("chunk")
    names = vertices.dtype.names or ()
    missing = [name for name in PACKED if name not in names]
    if missing or chunks is None or len(chunks) * CHUNK < len(vertices):
        found = f"no property {', '.join(missing)}" if missing else "too few chunks"
        raise InputError(f"has {found}", where=path, expected="a compressed PlayCanvas PLY file")
    position, turn, scale, colour = (vertices[name].astype(np.uint32) for name in PACKED)
    chunk = np.arange(len(vertices)) // CHUNK

    def within(fractions: np.ndarray, suffixes: tuple[str, ...]) -> np.ndarray:
        low, high = (_columns(chunks, tuple(f"{end}_{s}" for s in suffixes))[chunk] for end in ("min", "max"))
        return low + fractions * (high - low)

    bytes_ = np.stack([(colour >> shift) & 255 for shift in (24, 16, 8, 0)], axis=-1) / np.float32(255)
    rgb = bytes_[:, :3]
    if "min_r" in (chunks.dtype.names or ()):
        rgb = within(rgb, ("r", "g", "b"))
    harmonics = ((rgb - 0.5) / C0)[:, None]
    extra = elements.get("sh")
    if extra is not None and len(extra) == len(vertices):
        rest = _rest(extra, len(extra.dtype.names or ()), path)
        harmonics = np.concatenate([harmonics, (rest - 127.5) / 32], axis=1)
    return gaussians_of(
        within(_unpacked(position), MEANS),
        within(_unpacked(scale), ("scale_x", "scale_y", "scale_z")),
        smallest_three(turn >> 30, _tens(turn) * np.float32(2) - 1),
        logit(bytes_[:, 3]),
        harmonics,
    )


def _unpacked(packed: np.ndarray) -> np.ndarray:
    """Return three fractions of 11, 10 and 11 bits."""
    parts = ((packed >> 21) / 2047, ((packed >> 11) & 1023) / 1023, (packed & 2047) / 2047)
    return np.stack(parts, axis=-1).astype(np.float32)


def _tens(packed: np.ndarray) -> np.ndarray:
    """Return three fractions of 10 bits."""
    return np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=-1) / np.float32(1023)
