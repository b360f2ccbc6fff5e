"""PlayCanvas SOG: images (WebP) of quantized numbers next to a ``meta.json``, in a folder or a zip archive ``.sog``."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from bidnerf_core.errors import InputError
from bidnerf_core.io import Allowance, Archive, parse_json, read_file
from bidnerf_gaussians.formats.parts import gaussians_of, logit, smallest_three, take_gaussians
from bidnerf_gaussians.gaussians import COEFFICIENTS, Gaussians

META = "meta.json"
EXPECTED = "a SOG folder or archive"
LARGEST_IMAGE = 64 * 2**20
"""Pixels: one for each Gaussian."""
PALETTE_WIDTH = 64
"""Number of palette entries per row of the image of harmonics."""

Member = Callable[[str], bytes]


def recognises(path: Path) -> bool:
    """Return whether the path is a .sog archive, a ``meta.json`` that names images of means, or a folder with one."""
    if path.suffix.lower() == ".sog":
        return path.is_file()
    folder = path.parent if path.name == META else path
    return path.exists() and (folder / META).is_file() and (folder / "means_l.webp").is_file()


def read(path: Path) -> Gaussians:
    """Read the Gaussians of a folder or archive of version 2. Raises ``InputError`` for other versions, and
    if it is damaged.
    """
    member = _members(path)
    meta = parse_json(member(META), f"{path}: {META}", EXPECTED)
    try:
        return _decoded(meta, member, path)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OSError) as error:
        found = f"is damaged ({type(error).__name__}: {error})"
        raise InputError(found, where=path, expected=EXPECTED) from error


def _members(path: Path) -> Member:
    """Return a function that returns the content of a member, whose size is checked before it is unpacked."""
    if path.suffix.lower() != ".sog":
        folder = path.parent if path.name == META else path

        def of_folder(name: str) -> bytes:
            if Path(name).name != name:
                raise InputError(f"names a file {name!r}", where=path, expected=f"one next to {META}")
            return read_file(folder / name, f"a part of {EXPECTED}")

        return of_folder
    return Archive(path, EXPECTED).read


def _decoded(meta: Any, member: Member, path: Path) -> Gaussians:
    if meta.get("version") != 2:
        raise InputError(f"version {meta.get('version')!r} of its {META}", where=path, expected="2")
    count = meta["count"]
    if type(count) is not int or not 0 < count <= LARGEST_IMAGE:
        raise InputError(f"declares {count!r} Gaussians", where=path, expected=f"1 to {LARGEST_IMAGE:,}")
    allowance = Allowance.of(path.parent if path.name == META else path, EXPECTED)
    take_gaussians(allowance, count, COEFFICIENTS[meta["shN"]["bands"]] if "shN" in meta else 1)

    def pixels(part: str, number: int = 0) -> np.ndarray:
        name = meta[part]["files"][number]
        found = _image(member(name), f"{path}: {name}", allowance).reshape(-1, 4)
        if len(found) < count:
            raise InputError(f"{name} has {len(found):,} pixels, too few for {count:,} Gaussians", where=path)
        return found[:count]

    def book(part: str) -> np.ndarray:
        values = np.array(meta[part]["codebook"], dtype=np.float32)
        if values.shape != (256,):
            raise InputError(f"a codebook of {values.shape} in {part}", where=path, expected="256 numbers")
        return values

    low, high = (np.array(meta["means"][end], dtype=np.float32) for end in ("mins", "maxs"))
    steps = pixels("means", 0)[:, :3] + 256 * pixels("means", 1)[:, :3].astype(np.int32)
    logarithm = low + (high - low) * (steps / np.float32(65535))
    turn = pixels("quats")
    colour = pixels("sh0")
    harmonics = book("sh0")[colour[:, :3]][:, None]
    if "shN" in meta:
        harmonics = np.concatenate(
            [harmonics, _rest(meta["shN"], book("shN"), pixels, member, path, allowance)], axis=1
        )
    return gaussians_of(
        np.sign(logarithm) * np.expm1(np.abs(logarithm)),
        book("scales")[pixels("scales")[:, :3]],
        smallest_three(turn[:, 3].astype(np.int32) - 252, turn[:, :3] / np.float32(127.5) - 1),
        logit(colour[:, 3] / np.float32(255)),
        harmonics,
    )


def _rest(
    meta: Any,
    book: np.ndarray,
    pixels: Callable[[str, int], np.ndarray],
    member: Member,
    path: Path,
    allowance: Allowance,
) -> np.ndarray:
    """Return the harmonics (n k 3) above degree 0: each Gaussian refers to a palette entry."""
    count = COEFFICIENTS[meta["bands"]] - 1
    labels = pixels("shN", 1).astype(np.int32)
    entry = labels[:, 0] + 256 * labels[:, 1]
    palette = _image(member(meta["files"][0]), f"{path}: {meta['files'][0]}", allowance)
    if palette.shape[1] != PALETTE_WIDTH * count:
        raise InputError(f"a palette {palette.shape[1]} wide", where=path, expected=PALETTE_WIDTH * count)
    entries = palette[..., :3].reshape(-1, count, 3)  # row by row, with ``PALETTE_WIDTH`` entries per row
    if int(entry.max()) >= len(entries):
        raise InputError(f"names entry {int(entry.max())} of a palette of {len(entries)}", where=path)
    return book[entries[entry]]


def _image(content: bytes, where: str, allowance: Allowance) -> np.ndarray:
    """Decode the pixels (h w 4) of an image, whose size is checked before decoding."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(content), formats=("WEBP", "PNG"))
            if image.width * image.height > LARGEST_IMAGE:
                raise InputError(
                    f"has {image.width} x {image.height} pixels",
                    where=where,
                    expected=f"at most {LARGEST_IMAGE:,}",
                )
            allowance.take(8 * image.width * image.height)
            return np.asarray(image.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"is not a readable image ({error})", where=where, expected="a lossless WebP") from error
