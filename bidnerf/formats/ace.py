"""Folders of images that have one pose file each: the layouts of ACE (https://github.com/nianticlabs/ace) and of NSVF.

ACE, DSAC* and Wayspots: ``train/rgb/NAME.jpg`` has ``train/poses/NAME.txt`` (4x4, camera to world, OpenCV axes, metres) and
``train/calibration/NAME.txt`` (the focal length in pixels, or a 3x3 matrix), perhaps ``train/depth/NAME.png`` (planar z in
millimetres, of the image); ``test`` is alike. A name ends at its first dot, as in ``frame-000000.color.png``.

NSVF: ``rgb/0_NAME.png`` has ``pose/0_NAME.txt``; ``intrinsics.txt`` is a 4x4 matrix, or ``focal cx cy``. The digits 0, 1 and
2 in front of a name stand for train, val and test.

Principal points are as stored: the centre of the upper left pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from bidnerf.formats.scannet import read_matrix
from bidnerf_core.datasets import Capture, DatasetOptions, DepthFile, Format, Shot, first_file, read_pose_matrix
from bidnerf_core.depth import MILLIMETRE, DepthReader
from bidnerf_core.errors import InputError
from bidnerf_core.frames import photos_in
from bidnerf_core.io import is_file, read_header

PREFIXES = {"0": "train", "1": "val", "2": "test"}


def _read(path: Path, parts: list[tuple[Path, Path]], options: DatasetOptions) -> Capture:
    """Read the poses and calibrations. Raises ``InputError`` if one is invalid."""
    unit, read, shots = options.depth_unit or MILLIMETRE, DepthReader(documented=("65535",)), list[Shot]()
    for part, poses in parts:
        files, calibrations = (
            {file.name.partition(".")[0]: file for file in folder.glob("[!.]*.txt")}
            for folder in (poses, part / "calibration")
        )
        of_all = first_file(part, "intrinsics.txt")
        for image in photos_in(part / "rgb")[0]:
            name = image.name.partition(".")[0]
            calibration = calibrations.get(name, of_all)
            if calibration is None:
                raise InputError("has no calibration", where=image, expected=f"{part.name}/calibration/{name}.txt")
            header, depth = read_header(image), first_file(part / "depth", f"{name}.png", f"{name}.depth.png")
            pose = read_pose_matrix(files[name]) if name in files else None
            split = part.name if part != path else PREFIXES.get(name.partition("_")[0]) if of_all else None
            shots.append(
                Shot(
                    image=image,
                    stem=name,
                    camera=read_matrix(calibration, (header.width, header.height), first_centre=0),
                    T_world_camera=pose,
                    depth=None if depth is None else DepthFile(depth, partial(read, depth, unit)),
                    splits=(split,) if split and pose is not None else (),
                )
            )
    expected = "a .txt file of 16 finite numbers for each image"
    return Capture(path, shots, options.colour, "metres", depth_unit=unit, poses_expected=expected)


def _find(path: Path) -> list[tuple[Path, Path]]:
    """Return the folders that have ``rgb``, with their folders of poses: those of the splits, or else the folder itself."""
    found = list[tuple[Path, Path]]()
    for part in (path / "train", path / "val", path / "test", path):
        poses = next((folder for name in ("poses", "pose") if (folder := part / name).is_dir()), None)
        has_calibration = (part / "calibration").is_dir() or is_file(part / "intrinsics.txt")
        if poses is not None and (part / "rgb").is_dir() and has_calibration and not (part == path and found):
            found.append((part, poses))
    return found


reader = Format(
    "ACE, DSAC* and Wayspots, and NSVF: one pose file an image, with splits, depth in millimetres",
    "train/rgb, train/poses and train/calibration (ACE), or rgb, pose and intrinsics.txt (NSVF)",
    _find,
    _read,
    ["depth_unit"],
    precedence=30,  # poses are metric or were scaled on purpose
)
