"""``.splat`` files: 32 bytes per Gaussian, without a header and without view dependence."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bidnerf_core.errors import InputError
from bidnerf_core.io import read_file
from bidnerf_gaussians.formats.parts import LARGEST_FILE, gaussians_of, logit
from bidnerf_gaussians.gaussians import Gaussians
from bidnerf_gaussians.spherical_harmonics import C0

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("turn", "u1", 4)])


def recognises(path: Path) -> bool:
    """Return whether the name ends in .splat: the file has no header."""
    return path.suffix.lower() == ".splat" and path.is_file()


def read(path: Path) -> Gaussians:
    """Read the Gaussians of a file: plain scales, one-byte colours and opacities, quaternions (b - 128) / 128."""
    content = read_file(path, "a .splat file", LARGEST_FILE)
    if not content or len(content) % ROW.itemsize:
        raise InputError(f"has {len(content):,} bytes", where=path, expected="a multiple of 32, the size of a Gaussian")
    rows = np.frombuffer(content, ROW)
    rgba = rows["rgba"] / np.float32(255)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scales"])
    quaternions = (rows["turn"].astype(np.float32) - 128) / 128
    return gaussians_of(rows["means"], log_scales, quaternions, logit(rgba[:, 3]), ((rgba[:, :3] - 0.5) / C0)[:, None])
