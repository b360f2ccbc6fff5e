"""Niantic's ``.spz`` files: versions 1 to 3, one gzip stream, and version 4, a Zstandard stream for each
attribute.

Axes in the file are x right, y up, z back; those of a PLY file are x right, y down, z forward. Reading and
writing convert them, so that a scene has the same coordinates in both.
"""

from __future__ import annotations

import struct
import zlib
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.io import Allowance, read_file, write_file
from bidnerf_gaussians.formats.parts import LARGEST_FILE, gaussians_of, logit, smallest_three, take_gaussians
from bidnerf_gaussians.gaussians import COEFFICIENTS, Gaussians

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")  # magic, version, count, degree, fraction bits, flags, reserved
HEADER_4 = struct.Struct("<4sIIBBBBI12x")  # ..., number of streams, offset of their sizes
EXPECTED = "an .spz file"
COLOUR_SCALE = 0.15
FLIP = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
"""Rotation from the axes of the file (x right, y up, z back) to x right, y down, z forward."""
ORIGIN = torch.zeros(3)


def recognises(path: Path) -> bool:
    """Return whether the file begins like an .spz file."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        start = file.read(4)
    return start == MAGIC or (start.startswith(GZIP) and path.suffix.lower() == ".spz")


def read(path: Path) -> Gaussians:
    """Read the Gaussians of a file. Raises ``InputError`` if its sizes do not match its header."""
    content = read_file(path, EXPECTED, LARGEST_FILE)
    sections, version, count, degree, bits = (
        _streams(content, path) if content.startswith(MAGIC) else _unzipped(content, path)
    )
    return _decoded(sections, version, count, degree, bits).similar(1.0, FLIP, ORIGIN)


def _sizes(version: int, count: int, degree: int) -> list[int]:
    """Return the numbers of bytes of positions, opacities, colours, scales, rotations and harmonics."""
    harmonics = 3 * (COEFFICIENTS[degree] - 1)
    each = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, harmonics)
    return [size * count for size in each]


def _checked(header: tuple[Any, ...], versions: range, path: Path) -> tuple[int, int, int, int]:
    magic, version, count, degree, bits = header[:5]
    if magic != MAGIC:
        raise InputError(f"begins with {magic!r}", where=path, expected=EXPECTED)
    if version not in versions:
        raise InputError(
            f"version {version}",
            where=path,
            expected=f"{versions[0]} to {versions[-1]} of {EXPECTED} like this",
        )
    if degree not in COEFFICIENTS:
        raise InputError(f"harmonics of degree {degree}", where=path, expected="0 to 3")
    if bits > 24:
        raise InputError(f"{bits} fraction bits", where=path, expected="0 to 24")
    take_gaussians(Allowance.of(path, EXPECTED), count, COEFFICIENTS[degree])
    return version, count, degree, bits


def _unzipped(content: bytes, path: Path) -> tuple[list[bytes], int, int, int, int]:
    stream = zlib.decompressobj(wbits=31)
    try:
        start = stream.decompress(content, HEADER.size)
        if len(start) < HEADER.size:
            raise InputError("is too short for a header", where=path, expected=EXPECTED)
        version, count, degree, bits = _checked(HEADER.unpack(start), range(1, 4), path)
        sizes = _sizes(version, count, degree)
        # No more than declared is ever unpacked.
        rest = stream.decompress(stream.unconsumed_tail, sum(sizes) or 1)
    except zlib.error as error:
        raise InputError(f"is damaged ({error})", where=path, expected=EXPECTED) from error
    if len(rest) < sum(sizes):
        raise InputError(
            f"declares {count:,} Gaussians, but its data ends after {len(rest):,} of {sum(sizes):,} bytes",
            where=path,
        )
    ends = np.cumsum([0, *sizes])
    return [rest[a:b] for a, b in pairwise(ends)], version, count, degree, bits


def _streams(content: bytes, path: Path) -> tuple[list[bytes], int, int, int, int]:
    if len(content) < HEADER_4.size:
        raise InputError("is too short for a header", where=path, expected=EXPECTED)
    header = HEADER_4.unpack_from(content)
    version, count, degree, bits = _checked(header, range(4, 5), path)
    number, place = header[6], header[7]
    sizes = _sizes(version, count, degree)
    wanted = [size for size in sizes if size]
    start = place + 16 * number
    if number != len(wanted) or place < HEADER_4.size or start > len(content):
        raise InputError(
            f"has {number} streams",
            where=path,
            expected=f"{len(wanted)} for {count:,} Gaussians of degree {degree}",
        )
    found = []
    for index, size in enumerate(wanted):
        packed, unpacked = struct.unpack_from("<QQ", content, place + 16 * index)
        if unpacked != size or start + packed > len(content):
            raise InputError(
                f"stream {index} has {unpacked:,} bytes", where=path, expected=f"{size:,}; is it truncated?"
            )
        found.append(_zstandard(content[start : start + packed], size, path))
        start += packed
    parts = iter(found)
    return [next(parts) if size else b"" for size in sizes], version, count, degree, bits


def _zstandard(content: bytes, size: int, path: Path) -> bytes:
    try:
        import zstandard
    except ImportError as error:
        raise InputError(
            "has version 4, which needs the package zstandard: pip install zstandard", where=path
        ) from error
    try:
        told = zstandard.get_frame_parameters(content).content_size  # which the library trusts, regardless of our limit
        if told not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise InputError(f"a stream unpacks to {told:,} bytes", where=path, expected=f"{size:,}")
        found = bytes(zstandard.ZstdDecompressor().decompress(content, max_output_size=size))
    except (zstandard.ZstdError, MemoryError) as error:
        raise InputError(f"is damaged ({error})", where=path, expected=EXPECTED) from error
    if len(found) != size:
        raise InputError(f"a stream has {len(found):,} bytes", where=path, expected=f"{size:,}")
    return found


def _decoded(sections: list[bytes], version: int, count: int, degree: int, bits: int) -> Gaussians:
    position, opacity, colour, scale, turn, harmonics = (np.frombuffer(part, np.uint8) for part in sections)
    rgb = (colour.reshape(count, 1, 3) / np.float32(255) - 0.5) / COLOUR_SCALE
    rest = (harmonics.reshape(count, COEFFICIENTS[degree] - 1, 3).astype(np.float32) - 128) / 128
    return gaussians_of(
        _halves(position, count) if version == 1 else _fixed(position, count, bits),
        scale.reshape(count, 3) / np.float32(16) - 10,
        _first_three(turn.reshape(count, 3)) if version < 3 else _smallest(turn.reshape(count, 4)),
        logit(opacity / np.float32(255)),
        np.concatenate([rgb, rest], axis=1),
    )


def _halves(found: np.ndarray, count: int) -> np.ndarray:
    return found.view("<f2").reshape(count, 3).astype(np.float32)


def _fixed(found: np.ndarray, count: int, bits: int) -> np.ndarray:
    """Convert 24-bit fixed-point numbers with ``bits`` fraction bits."""
    parts = found.reshape(count, 3, 3).astype(np.int32)
    whole = parts[..., 0] | parts[..., 1] << 8 | parts[..., 2] << 16
    return np.where(whole >= 2**23, whole - 2**24, whole) / np.float32(2**bits)


def _first_three(turn: np.ndarray) -> np.ndarray:
    """Return quaternions w, x, y, z, of which x, y and z are stored and w is not negative."""
    xyz = turn / np.float32(127.5) - 1
    w = np.sqrt(np.clip(1 - (xyz**2).sum(-1, keepdims=True), 0, None))
    return np.concatenate([w, xyz], axis=-1)


def _smallest(turn: np.ndarray) -> np.ndarray:
    """Return quaternions w, x, y, z, of which all but the largest component are stored, with 9 bits and a sign each."""
    packed = np.ascontiguousarray(turn).view("<u4")[:, 0]
    tens = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=-1)
    others = np.where(tens & 512, -1, 1) * (tens & 511) / np.float32(511)
    return np.roll(smallest_three(packed >> 30, others), 1, axis=-1)


def write(path: Path, gaussians: Gaussians) -> None:
    """Write version 3. Positions have as many fraction bits as the extent of the scene leaves of 24."""
    found = gaussians.similar(1.0, FLIP, ORIGIN)
    largest = max(1e-9, float(found.means.abs().max()) if len(found) else 1.0)
    bits = int(np.clip(np.floor(23 - np.log2(largest * (1 + 1e-6))), 0, 24))
    if largest * 2**bits >= 2**23:
        raise InputError(f"a Gaussian {largest:g} from the origin is too far for this format", where=path)
    fixed = np.round(found.means.double().numpy() * 2**bits).astype(np.int32) & 0xFFFFFF
    position = np.stack([fixed & 255, fixed >> 8 & 255, fixed >> 16], axis=-1)
    harmonics = found.harmonics.numpy()
    sections = (
        position,
        found.opacities.numpy() * 255,
        harmonics[:, 0] * COLOUR_SCALE * 255 + 127.5,
        (found.log_scales.numpy() + 10) * 16,
        _packed(found.quaternions.numpy()),
        harmonics[:, 1:] * 128 + 128,
    )
    body = b"".join(np.clip(np.round(part), 0, 255).astype(np.uint8).tobytes() for part in sections)
    # Version 3 is the newest one that the standard library can compress.
    header = HEADER.pack(MAGIC, 3, len(found), found.degree, bits, 0, 0)
    stream = zlib.compressobj(wbits=31)
    write_file(path, stream.compress(header + body) + stream.flush())


def _packed(quaternions: np.ndarray) -> np.ndarray:
    """Pack quaternions w, x, y, z into four bytes each, the inverse of ``_smallest``."""
    q = np.roll(quaternions.astype(np.float64), -1, axis=-1)
    q /= np.linalg.norm(q, axis=-1, keepdims=True).clip(1e-12)
    largest = np.abs(q).argmax(-1)
    rows = np.arange(len(q))
    q *= np.where(q[rows, largest] < 0, -1, 1)[:, None]
    others = q[np.arange(4) != largest[:, None]].reshape(len(q), 3)
    tens = np.round(np.abs(others) * np.sqrt(2) * 511).clip(0, 511).astype(np.uint32) | np.where(others < 0, 512, 0)
    packed = largest.astype(np.uint32) << 30 | tens[:, 0] << 20 | tens[:, 1] << 10 | tens[:, 2]
    return packed.astype("<u4").view(np.uint8).reshape(len(q), 4)
