"""The options for the cameras of images whose format stores none."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from bidnerf_core.cli.options import option
from bidnerf_core.datasets import DepthRegistration
from bidnerf_core.depth import DEPTH_SENSORS
from bidnerf_core.errors import UsageError
from bidnerf_core.frames import HiddenColour, MaskFolder

NO = "no"
"""The value of ``--register-depth`` with which depth is used as it is."""

one_camera = tyro.conf.create_mutex_group(
    required=False,
    title="camera of images whose format stores none (default: from EXIF or the map)",
)
CameraFile = Annotated[
    Path | None,
    one_camera,
    option(
        "CAMERA.json",
        "file with intrinsics from nerfstudio, COLMAP (cameras.txt), ROS or OpenCV (YAML), Open3D, hloc or"
        " 3D Gaussian Splatting; for a TUM RGB-D folder also freiburg1, freiburg2 or freiburg3",
        "",
    ),
]
FocalLength = Annotated[
    float | None, one_camera, option("PX", "focal length in pixels of the image file", "")
]
FieldOfView = Annotated[
    float | None, one_camera, option("DEG", "horizontal field of view of the upright image", "")
]
DatasetCamera = Annotated[
    Path | None,
    option(
        "CAMERA.json",
        "camera of a dataset whose files have none (TUM RGB-D: freiburg1, freiburg2, freiburg3, or a file;"
        " 7-Scenes: a file)",
        "as in the folder",
    ),
]
RegisterDepth = Annotated[
    str | None,
    option(
        "SENSOR.json",
        "file with the intrinsics of the depth camera and T_colour_depth (4x4), from which depth is registered to colour"
        " images; 'no' if depth is already registered",
        "as in the format",
    ),
]

DatasetDepthUnit = Annotated[
    float | None,
    option(
        "METRES", "metres per step of the depth images, such as 0.001 for millimetres", "as in the format"
    ),
]

Masks = Annotated[
    Path | None,
    option(
        "DIR",
        "masks named like the images: black pixels (--mask-hides) are ignored, such as people or the robot"
        " itself",
        "",
    ),
]
MaskHides = Annotated[HiddenColour, option("COLOUR", "colour in --masks that is ignored: black or white")]
DepthSensorName = Annotated[str, option("NAME", "what measured the depth:" + ", ".join(DEPTH_SENSORS))]


def mask_folder(masks: Path | None, hides: HiddenColour) -> MaskFolder | None:
    """Return the mask folder given by ``--masks`` and ``--mask-hides``. Raises ``UsageError`` for the latter alone."""
    if masks is None and hides != "black":
        raise UsageError(f"--mask-hides {hides} was given without --masks", expected="the folder of masks")
    return None if masks is None else MaskFolder(masks, hides)


def stated_reading(
    camera: Path | None, register_depth: str | None, depth_unit: float | None
) -> dict[str, Any]:
    """Return the options with which a dataset is opened, as the plain values that a plan of trials stores."""
    registration = depth_registration(register_depth)
    return {
        "camera": None if camera is None else str(camera),
        "register_depth": registration if registration in (None, False) else str(registration),
        "depth_unit": depth_unit,
    }


def depth_registration(given: str | None) -> DepthRegistration | None:
    """Return the depth registration that ``--register-depth`` selects."""
    return None if given is None else False if given == NO else Path(given)
