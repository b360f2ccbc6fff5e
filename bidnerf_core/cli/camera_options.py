"""The options that give the camera of images which have none in their format; at most one of them may be given."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from bidnerf_core.cli.common import option

one_camera = tyro.conf.create_mutex_group(
    required=False, title="the camera of images that have none in their format (default: as EXIF has it)"
)
CameraFile = Annotated[
    Path | None,
    one_camera,
    option("CAMERA.json", "file with intrinsics: transforms.json, cameras.json, COLMAP's cameras.txt", ""),
]
FocalLength = Annotated[
    float | None, one_camera, option("PX", "focal length in pixels of the image file", "")
]
FieldOfView = Annotated[
    float | None, one_camera, option("DEG", "horizontal field of view of the upright image", "")
]
