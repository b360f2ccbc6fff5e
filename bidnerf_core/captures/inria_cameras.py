"""Cameras in the ``cameras.json`` that the original code of 3D Gaussian splatting writes beside its result."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from pathlib import Path

import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures.cameras import StoredCamera
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.geometry import SE3, Similarity
from bidnerf_core.io import parse_record, read_file, write_file

NAME = "cameras.json"


def write_inria_cameras(folder: Path, cameras: Sequence[StoredCamera]) -> list[Path]:
    """Write a ``cameras.json``, unless there are no cameras, and return it.

    The principal points become the middles of the images, as the format does not have any.
    """
    if not cameras:
        return []
    rows = [
        {
            "id": number,
            "img_name": camera.name,
            "width": camera.intrinsics.width,
            "height": camera.intrinsics.height,
            "position": camera.pose.translation.tolist(),
            "rotation": camera.pose.rotation.tolist(),
            "fx": camera.intrinsics.fx,
            "fy": camera.intrinsics.fy,
        }
        for number, camera in enumerate(cameras)
    ]
    write_file(folder / NAME, (json.dumps(rows) + "\n").encode())
    return [folder / NAME]


def cameras_beside(path: Path, placement: Similarity) -> tuple[StoredCamera, ...]:
    """Return the cameras in the ``cameras.json`` beside a file or up to two folders above, transformed by ``placement``.

    There are none if there is no such file, or it is damaged or another program's, which is a warning.
    """
    folders = [path.parent, *list(path.parent.parents)[:2]]
    file = next((folder / NAME for folder in folders if (folder / NAME).is_file()), None)
    if file is None:
        return ()
    try:
        return _read(file, placement)
    except InputError as error:
        warnings.warn(f"{error}; ignored", InputWarning, stacklevel=2)
        return ()


def _read(file: Path, placement: Similarity) -> tuple[StoredCamera, ...]:
    record = parse_record(str(file), b'{"cameras":' + read_file(file, NAME) + b"}")
    cameras = []
    for entry in record.items("cameras") or []:
        try:
            camera = Intrinsics(
                float(entry["fx"]), float(entry["fy"]), entry["width"] / 2, entry["height"] / 2,
                int(entry["width"]), int(entry["height"]),
            )  # fmt: skip
            rotation = torch.tensor(entry["rotation"], dtype=torch.float64)
            position = placement.apply(torch.tensor(entry["position"], dtype=torch.float64))
            pose = SE3(placement.T_target_source.rotation.double() @ rotation, position)
            rows = tuple((r[0], r[1], r[2], r[3]) for r in pose.matrix().tolist())
            cameras.append(StoredCamera(str(entry["img_name"]), camera, rows))
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            raise InputError(
                f"camera {len(cameras)} is not readable ({error})", where=file, expected="Inria's layout"
            ) from error
    return tuple(cameras)
