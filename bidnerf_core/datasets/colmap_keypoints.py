"""Keypoints and descriptors of a model's images: COLMAP's database, or the features of hloc (.h5).

In both, the keypoints of an image are in the order in which the model lists its observations. COLMAP's SIFT descriptors have
the root normalisation and the layout of ours, so that they match; its scale is half of our diameter. hloc's keypoints are the
first pixel's centre (0, 0), COLMAP's (0.5, 0.5).
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import numpy as np
import torch

from bidnerf_core.errors import InputError
from bidnerf_core.mapping import FIRST_CENTRE, Keypoints, quantized

UNKNOWN_SCALE = 4.0
"""Scale (pixels) of keypoints that state none."""


def stored_keypoints(path: Path) -> Iterator[tuple[str, Keypoints]]:
    """Yield the name and the keypoints of each image in a database or a file of features, by its ending.

    Raises ``InputError`` for a file that cannot be read, and if h5py, which features of hloc need, is not installed.
    """
    read = _of_features if path.suffix == ".h5" else _of_database
    for name, pixels, scales, descriptors in read(path):
        count = len(pixels)
        if not (
            len(scales) == len(descriptors) == count and np.isfinite(pixels).all() and (scales > 0).all()
        ):
            raise InputError(
                f"image {name!r} has {count} keypoints, {len(scales)} scales and {len(descriptors)} descriptors",
                where=path,
                expected="finite numbers for each keypoint",
            )
        # OpenCV's diameter of a keypoint is twice the scale of the Gaussian at which it was found.
        sizes = torch.from_numpy(2 * np.asarray(scales, dtype=np.float32))
        numbers = torch.from_numpy(np.array(descriptors))
        if numbers.dtype != torch.uint8:
            numbers = quantized(numbers.float())
        yield name, Keypoints(torch.from_numpy(np.array(pixels, dtype=np.float32)), sizes, numbers)


def _of_database(path: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    query = (
        "SELECT name, k.rows, k.cols, k.data, d.rows, d.cols, d.data FROM images"
        " JOIN keypoints AS k ON k.image_id = images.image_id JOIN descriptors AS d ON d.image_id = images.image_id"
    )
    try:  # immutable: nothing is written beside it
        address = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        with contextlib.closing(sqlite3.connect(address, uri=True)) as opened:
            for name, *found in opened.execute(query):
                keypoints, descriptors = (
                    np.frombuffer(data or b"", kind).reshape(rows, columns)
                    for (rows, columns, data), kind in zip((found[:3], found[3:]), ("<f4", "u1"), strict=True)
                )
                yield str(name), keypoints[:, :2], _scales(keypoints), descriptors
    except (sqlite3.Error, ValueError, TypeError) as error:
        raise InputError(f"cannot be read: {error}", where=path, expected="a database of COLMAP") from error


def _scales(keypoints: np.ndarray) -> np.ndarray:
    """Return the scales of keypoints stored as (x, y), (x, y, scale, orientation) or (x, y, 2x2 affine shape)."""
    if keypoints.shape[1] == 6:
        a, b, c, d = keypoints[:, 2:].T
        return np.sqrt(np.abs(a * d - b * c)).clip(1e-3)
    if keypoints.shape[1] == 4:
        return keypoints[:, 2].clip(1e-3)
    return np.full(len(keypoints), UNKNOWN_SCALE, dtype=np.float32)


def _of_features(path: Path) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    try:
        import h5py
    except ImportError as error:
        raise InputError("features of hloc need h5py (pip install h5py)", where=path) from error

    def images(group: Any, parents: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
        """Yield the groups that hold keypoints; the folders of an image's name are nested groups."""
        if "keypoints" in group:
            yield str(PurePosixPath(*parents)), group
            return
        for name in group:
            yield from images(group[name], (*parents, name))

    try:
        with h5py.File(path, "r") as opened:
            for name, group in images(opened, ()):
                pixels = np.asarray(group["keypoints"], dtype=np.float32)[:, :2] + FIRST_CENTRE
                scales = (
                    np.asarray(group["scales"]) if "scales" in group else np.full(len(pixels), UNKNOWN_SCALE)
                )
                yield name, pixels, scales, np.asarray(group["descriptors"], dtype=np.float32).T
    except (OSError, KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(f"cannot be read: {error}", where=path, expected="features of hloc") from error
