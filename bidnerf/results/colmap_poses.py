"""COLMAP text models (``images.txt``, with ``cameras.txt`` and ``points3D.txt`` next to it), and the poses of hloc.

See https://colmap.github.io/format.html. COLMAP's poses are world to camera, quaternions have the scalar
first, and pixel centres are at +0.5, as in this package.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from bidnerf.results.pose_files import PosedImage, frame_of
from bidnerf.results.pose_formats import HEAD, check_pose_file
from bidnerf_core.camera import Intrinsics, colmap_model
from bidnerf_core.errors import InputError, printable
from bidnerf_core.io import write_file

SAME_CAMERA = 0.5
"""Pixels by which cameras differ that are written as one: localization estimates a photo's own camera, with an error of its own."""


def write_colmap_poses(path: Path, images: Sequence[PosedImage], refused: Sequence[str] = ()) -> None:
    """A COLMAP model: images.txt, and cameras.txt and points3D.txt beside it.

    Image names are file paths relative to the folder that contains all of the images. Keypoints that agree with landmarks of the map
    are the POINTS2D of an image, and these landmarks the 3D points, numbered as in an export of the map. Images share a camera if theirs
    differ by less than ``SAME_CAMERA``. Raises ``InputError`` for a lens that COLMAP cannot describe, and as ``check_pose_file`` does.
    """
    check_pose_file(path)
    stored, cameras = images_by_file(images), list[Intrinsics]()
    for number, image in enumerate(stored):
        camera = next((each for each in cameras if _is_same(each, image.intrinsics)), image.intrinsics)
        stored[number] = replace(image, intrinsics=camera)
        cameras += [camera] if camera not in cameras else []
    matches = [image.matches for image in stored if image.matches is not None]
    points = None
    if matches:
        landmarks, rows = np.unique(torch.cat([each.landmark for each in matches]).numpy(), return_index=True)
        positions = torch.cat([each.positions for each in matches])[rows]
        points = torch.from_numpy(landmarks).long(), positions, torch.full((len(landmarks), 3), 128)
    write_colmap_model(path, stored, points, refused)


def images_by_file(images: Sequence[PosedImage]) -> list[PosedImage]:
    """Return the images as their files store them, each named by its file's path relative to the folder that contains all of them."""
    files = [image.file for image in images if image.file is not None]
    folder = os.path.commonpath([file.resolve().parent for file in files]) if files else ""
    names = [
        image.name if image.file is None else Path(os.path.relpath(image.file.resolve(), folder)).as_posix()
        for image in images
    ]
    return [replace(image.as_stored, name=name) for image, name in zip(images, names, strict=True)]


def _is_same(one: Intrinsics, other: Intrinsics) -> bool:
    """Return whether two cameras see the same rays at the border of the image, up to ``SAME_CAMERA``."""
    sizes = [(camera.width, camera.height, len(camera.distortion)) for camera in (one, other)]
    if sizes[0] != sizes[1]:
        return False
    u, v = (torch.linspace(0, side, 5, dtype=torch.float64) for side in sizes[0][:2])
    pixels = torch.cartesian_prod(u, v)
    return bool(((other.project(one.unproject(pixels)) - pixels).norm(dim=-1) < SAME_CAMERA).all())


def write_colmap_model(
    path: Path,
    images: Sequence[PosedImage],
    points: tuple[Int[Tensor, "n"], Float[Tensor, "n 3"], Int[Tensor, "n 3"]] | None = None,
    refused: Sequence[str] = (),
) -> None:
    """Write a COLMAP text model; image names, poses, cameras and matches must already be those of the stored files.

    ``points`` are the numbers (ascending), the positions (world) and the colours (0 to 255) of the landmarks that become 3D points; their
    tracks and the POINTS2D of the images are the ``matches`` of the images. ``refused`` images are named in comments. Characters in names
    that would break a row are escaped.
    """
    head = f"{HEAD}; {frame_of(images, 'world to camera')}\n"
    numbers, positions, colours = points or (torch.zeros(0).long(), torch.zeros((0, 3)), torch.zeros((0, 3)).long())
    positions = positions.double()
    tracks = [list[str]() for _ in range(len(numbers))]
    total, count = torch.zeros(2, len(numbers), dtype=torch.float64)
    cameras, rows = dict[Intrinsics, int](), list[str]()
    for number, image in enumerate(images, start=1):
        T, matches, keypoints = image.pose.inverse(), image.matches, list[str]()
        if matches is not None and points is not None:
            seen, pixels = torch.searchsorted(numbers, matches.landmark.long()), matches.pixels.double()
            distances = (image.intrinsics.project(T.apply(positions[seen])) - pixels).norm(dim=-1)
            total.index_add_(0, seen, distances)
            count.index_add_(0, seen, torch.ones_like(distances))
            for index, (point, (u, v)) in enumerate(zip(seen.tolist(), pixels.tolist(), strict=True)):
                tracks[point].append(f" {number} {index}")
                keypoints.append(f"{u:.6g} {v:.6g} {int(numbers[point]) + 1}")
        pose = " ".join(f"{x:.15g}" for x in (*T.quaternion("wxyz").tolist(), *T.translation.tolist()))
        own = cameras.setdefault(image.intrinsics, len(cameras) + 1)
        rows.append(f"{number} {pose} {own} {printable(image.name)}\n{' '.join(keypoints)}\n")
    # The error of a point is the mean distance of its projections from its keypoints. With a single keypoint, the error is unknown,
    # for which COLMAP has the value -1.
    errors = torch.where(count > 1, total / count.clamp(min=1), -1).tolist()
    columns = zip(numbers.tolist(), positions.tolist(), colours.tolist(), errors, tracks, strict=True)
    listed = [
        f"{number + 1} {x:.15g} {y:.15g} {z:.15g} {r} {g} {b} {error:.3f}{''.join(track)}\n"
        for number, (x, y, z), (r, g, b), error, track in columns
    ]
    lenses = list[str]()
    for camera, number in cameras.items():
        model, parameters = colmap_model(camera)
        lens = [f"{x:.15g}" for x in parameters]
        lenses.append(" ".join([f"{number} {model} {camera.width} {camera.height}", *lens]) + "\n")
    contents = {
        "cameras.txt": ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n", *lenses],
        "points3D.txt": ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n", *listed],
        path.name: [
            *(f"# without a pose: {printable(each)}\n" for each in refused),
            "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then POINTS2D[] as (X, Y, POINT3D_ID)\n",
            *rows,
        ],
    }
    for name, lines in contents.items():
        write_file(path.with_name(name), "".join([head, *lines]).encode())


def write_hloc_poses(path: Path, images: Sequence[PosedImage]) -> None:
    """Poses in the format of hloc and the visual localization benchmark: rows of name, quaternion (w, x, y, z) and translation, world to camera.

    Images are named as in a COLMAP model, see ``write_colmap_poses``. Raises ``InputError`` for a name with a space, which ends a name.
    """
    rows = list[str]()
    for image in images_by_file(images):
        if re.search(r"\s", image.name):
            raise InputError(
                f"the image {image.name!r} has a space in its name", where=path, expected="images.txt or .json"
            )
        T = image.pose.inverse()
        numbers = (*T.quaternion("wxyz").tolist(), *T.translation.tolist())
        rows.append(f"{printable(image.name)} {' '.join(f'{x:.15g}' for x in numbers)}\n")
    write_file(path, "".join(rows).encode())
