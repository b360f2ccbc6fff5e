"""Captures of LLFF (https://github.com/Fyusion/LLFF), as NeRF's and Mip-NeRF 360's scenes are distributed: ``poses_bounds.npy``.

Each row of this file has 17 numbers for one image of ``images`` in the order of Python's ``sorted`` (10.png before 9.png): a 3x5 matrix, row by row,
and the nearest and farthest depth. The first four columns of the matrix are the camera-to-world pose whose
axes point down, to the right and backwards; the fifth holds the height, the width and the focal length in
pixels. The principal point is the image centre. Where ``images`` is missing, its reduced copies
(``images_4`` ...) are used, with cameras scaled to them. The unit of length is arbitrary, as in COLMAP,
from which the poses come.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from bidnerf_core.datasets import Capture, DatasetOptions, Format, Shot, camera_of, first_file
from bidnerf_core.errors import InputError, amount
from bidnerf_core.frames import photos_in
from bidnerf_core.geometry import rigid_pose
from bidnerf_core.io import read_array

POSES_FILE = "poses_bounds.npy"


def _read(path: Path, file: Path, options: DatasetOptions) -> Capture:
    """Read the poses. Raises ``InputError`` if they are invalid or not as many as the images."""
    rows = read_array(file, "LLFF's poses")
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind != "f":
        found = f"has an array of shape {rows.shape} and type {rows.dtype}"
        raise InputError(found, where=file, expected="rows of 17 numbers")
    if not np.isfinite(rows).all():
        raise InputError("has numbers that are not finite", where=file, expected="finite ones")
    folders = [options.image_folder or path / name for name in ("images", "images_2", "images_4", "images_8")]
    images = sorted(
        next((photos for f in folders if f.is_dir() and (photos := photos_in(f)[0])), [])
    )  # not natural order
    if len(images) != len(rows):
        found = f"has {amount(len(rows), 'pose')} for {amount(len(images), 'image')}"
        raise InputError(found, where=file, expected="one for each, in the order of names")
    shots = list[Shot]()
    for number, (row, image) in enumerate(zip(rows, images, strict=True)):
        where, matrix = f"{file}: row {number}", torch.from_numpy(row[:15].astype(np.float64).reshape(3, 5))
        down, right, back, position, (height, width, focal) = matrix.unbind(1)
        pose = rigid_pose(torch.stack([right, down, -back, position], 1), where)
        size, f = (round(float(width)), round(float(height))), float(focal)
        shots.append(
            Shot(
                image=image,
                camera=camera_of(where, (f, f, size[0] / 2, size[1] / 2), size, first_centre=0),
                T_world_camera=pose,
            )
        )
    return Capture(path, shots, options.colour, pose_file=file)


reader = Format(
    "LLFF and Mip-NeRF 360, without depth",
    f"images with {POSES_FILE} (LLFF)",
    lambda path: first_file(path, POSES_FILE),
    _read,
    ["images"],
    precedence=16,  # made from a COLMAP model, without the distortion of its lens
)
