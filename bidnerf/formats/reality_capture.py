"""Photos whose cameras were exported by RealityCapture as comma-separated values ("Internal/External camera
parameters").

The columns are ``#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2``. The rotation of the camera
(OpenGL axes) is ``Rz(-heading) Rx(pitch) Ry(roll)``, in degrees, in a world whose z points up. ``f`` is the
focal length in millimetres for a film 36 mm wide, ``px`` and ``py`` are the offset of the principal point
from the image centre, both relative to the longer side of the photo; ``k1`` to ``t2`` are Brown's
distortion in OpenCV's convention. Photos are in the folder, or in ``images``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.camera import camera_of_record
from bidnerf_core.datasets import (
    Capture,
    DatasetOptions,
    FileNames,
    Format,
    Shot,
    column_names,
    read_table,
)
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3
from bidnerf_core.io import Record, Row, open_binary, read_header

NUMBERS = ("x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
POSE_FIELDS = NUMBERS[:6]


def _read(path: Path, file: Path, options: DatasetOptions) -> Capture:
    """Read the list. Raises ``InputError`` if a row is invalid."""
    columns = "the columns of the export 'Internal/External camera parameters', which has focal lengths (f)"
    names = FileNames(path, path / "images", path / "input", images=options.image_folder)
    rows = read_table(file, "a list of cameras", columns, {"name", "f", *POSE_FIELDS})
    return Capture(path, names.shots({v["name"]: (row, v) for row, v in rows}, _shot), options.colour, pose_file=file)


def _find(path: Path) -> Path | None:
    heads = file_heads(path, "*.csv", "a list of cameras")
    tables = ((file, column_names(head.partition(b"\n")[0].decode("utf-8-sig", "replace"))) for file, head in heads)
    return next((file for file, names in tables if names[:1] == ["name"] and set(POSE_FIELDS) <= set(names)), None)


def file_heads(path: Path, pattern: str, expected: str) -> Iterator[tuple[Path, bytes]]:
    """Yield the readable files of a folder whose names match a pattern, each with its first bytes."""
    for file in sorted(path.glob(pattern)):
        with contextlib.suppress(InputError), open_binary(file, expected) as opened:
            yield file, opened.read(4096)


def _shot(image: Path, name: str, listed: tuple[Row, dict[str, str]]) -> Shot:
    row, values = listed
    number = {key: row.numbers([values.get(key) or "0"])[0] for key in NUMBERS}
    angles = [-number["heading"], number["pitch"], number["roll"]]
    turn = torch.from_numpy(Rotation.from_euler("ZXY", angles, degrees=True).as_matrix())
    position = torch.tensor([number[key] for key in POSE_FIELDS[:3]], dtype=torch.float64)
    pose = SE3(turn * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64), position)
    width, height = read_header(image).size
    side = max(width, height)
    # Focal lengths refer to a film 36 mm wide.
    lens = {"fl_x": number["f"] * side / 36.0, "p1": number["t1"], "p2": number["t2"]}
    lens |= {"cx": width / 2 + number["px"] * side, "cy": height / 2 + number["py"] * side}
    lens |= {key: number[key] for key in ("k1", "k2", "k3", "k4")}
    camera = camera_of_record(Record(row.where, lens), (width, height))
    return Shot(image=image, camera=camera, T_world_camera=pose)


reader = Format(
    "cameras exported by RealityCapture, without depth",
    "photos with a .csv of #name,x,y,alt,heading,pitch,roll,f (RealityCapture)",
    _find,
    _read,
    ["images"],
    precedence=25,  # exported by hand, so preferred to a model of COLMAP
)
