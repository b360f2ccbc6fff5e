"""Folders of images that have one pose file each: the layouts of ACE (https://github.com/nianticlabs/ace) and of NSVF.

ACE, DSAC* and Wayspots: ``train/rgb/NAME.jpg`` has ``train/poses/NAME.txt`` (4x4, camera to world, OpenCV axes, metres) and
``train/calibration/NAME.txt`` (the focal length in pixels, or a 3x3 matrix), perhaps ``train/depth/NAME.png`` (planar z in
millimetres, of the image); ``test`` is alike. A name ends at its first dot, as in ``frame-000000.color.png``.

NSVF: ``rgb/0_NAME.png`` has ``pose/0_NAME.txt``; ``intrinsics.txt`` is a 4x4 matrix, or ``focal cx cy``. The digits 0, 1 and
2 in front of a name stand for train, val and test.

Principal points are as stored: the centre of the upper left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

from bidnerf.formats.layouts import Layout
from bidnerf_core.camera import Intrinsics
from bidnerf_core.datasets import Capture, DatasetOptions, Format, Shot, camera_of
from bidnerf_core.depth import MILLIMETRE
from bidnerf_core.errors import InputError
from bidnerf_core.io import is_file, read_rows

ACE = Layout(
    (("train/rgb", "val/rgb", "test/rgb"), ("rgb",)),
    pose=("../poses/{name}.txt", "../pose/{name}.txt"),
    camera=("../calibration/{name}.txt", "../intrinsics.txt"),
    depth=("../depth/{name}.png", "../depth/{name}.depth.png"),
)
PREFIXES = {"0": "train", "1": "val", "2": "test"}


def _read(path: Path, images: list[Path], options: DatasetOptions) -> Capture:
    """Read the poses and calibrations. Raises ``InputError`` if one is invalid."""
    unit, has_digits, shots = options.depth_unit or MILLIMETRE, is_file(path / "intrinsics.txt"), list[Shot]()
    for image, shot in zip(images, ACE.shots(images, partial(read_matrix, first_centre=0), unit), strict=True):
        digit, part = shot.stem.partition("_")[0] if has_digits else "", image.parents[1]
        split = PREFIXES.get(digit) if part == path else part.name
        shots.append(replace(shot, splits=(split,) if split and shot.T_world_camera else ()))
    return Capture(
        path,
        shots,
        options.colour,
        "metres",
        depth_unit=unit,
        poses_expected="a .txt file of 16 finite numbers for each image",
    )


def read_matrix(file: Path, size: tuple[int, int], first_centre: float = 0.5) -> Intrinsics:
    """Return the camera of a matrix, of a focal length, or of NSVF's focal length and principal point, for images of a ``size``.

    ``first_centre`` is added to a principal point, see ``camera_of``. Raises ``InputError`` for a file with none of these.
    """
    expected = "a matrix of intrinsics, 3x3 or 4x4"
    rows = [row.numbers(row.text.replace(",", " ").split()) for row in read_rows(file, "intrinsics", expected)]
    match rows:
        case [[f]]:
            numbers = f, f, size[0] / 2 - first_centre, size[1] / 2 - first_centre
        case [[f, cx, cy, *_], *_] if cx:
            numbers = f, f, cx, cy
        case [[fx, _, cx, *_], [_, fy, cy, *_], [_, _, _, *_], *_]:
            numbers = fx, fy, cx, cy
        case _:
            raise InputError(f"has {len(rows)} rows", where=file, expected=expected)
    return camera_of(file, numbers, size, first_centre=first_centre)


reader = Format(
    "ACE, DSAC* and Wayspots, and NSVF: one pose file an image, with splits, depth in millimetres",
    "train/rgb, train/poses and train/calibration (ACE), or rgb, pose and intrinsics.txt (NSVF)",
    ACE.images,
    _read,
    ["depth_unit"],
    precedence=30,  # poses are metric or were scaled on purpose
)
