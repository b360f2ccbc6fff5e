"""The description of a map: the content of its ``map.json``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import PoseRefinement, StoredCamera, with_wrong_pose
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SceneBounds
from bidnerf_core.geometry import SE3, LengthUnit
from bidnerf_core.io import from_plain, read_json
from bidnerf_core.mapping import USUAL_FEATURES

FORMAT = "bidnerf map"
VERSION = 1
DESCRIPTION = "map.json"
EXPECTED_PART = "a safetensors file, without which the map is incomplete"

LandmarkSource = Literal["photos", "rendered images"]


@dataclass(frozen=True)
class FieldFrame:
    """The length unit in which the field of a map was trained, if the map was scaled later."""

    scale: float  # units of the map per unit of the field
    bounds: SceneBounds  # of the field, in its own unit

    def __post_init__(self) -> None:
        if not 0 < self.scale < math.inf:
            raise InputError(f"scale is {self.scale}", expected="a positive number")


@dataclass(frozen=True)
class MapInfo:
    """The content of ``map.json``."""

    backend: str
    config: dict[str, Any]
    bounds: SceneBounds
    step: int  # training steps done
    complete: bool  # whether training has finished
    data: str = ""  # name of the dataset's folder
    seconds: float = 0.0  # of training
    cameras: tuple[StoredCamera, ...] = ()
    pose_refinement: PoseRefinement | None = None  # of the cameras; None if nothing is known
    unit: LengthUnit = "units"  # of all lengths in the map; "units" if their length is unknown
    # Of the map's own coordinates, in the world of poses that enter and leave it. All positions of the map, such as those
    # of its cameras and bounds, are relative to it: in survey coordinates, single precision resolves only decimetres.
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    added: int = 0  # number of cameras added after training, at the end of ``cameras``
    gravity_up: tuple[float, float, float] | None = (
        None  # upward direction (world), if the capture measured gravity
    )
    field_frame: FieldFrame | None = None  # set if the map was scaled after training
    distances: bool = True  # False if all images are from one place and thus do not determine distances
    sparse_depth: int = 0  # number of training pixels whose depth came from structure from motion
    hidden: int = 0  # number of training pixels that masks hid
    weights: str = ""  # file names
    training: str | None = None  # the state needed to resume; dropped when training is complete
    surface: str | None = None  # baked from these weights
    landmarks: str | None = None
    landmark_source: LandmarkSource | None = None  # the images they were built from, if recorded
    landmark_features: str = USUAL_FEATURES  # name of the detector of their keypoints
    capture: str | None = None  # capture record of the photos the landmarks were built from
    anchor: str | None = None  # takes the place of ``anchor.json`` while a file of this name exists
    colour_noise: float | None = None  # root mean square error of rendered colours on training images
    bidnerf: str = field(default_factory=lambda: version("bidnerf"))
    format: str = FORMAT
    version: int = VERSION

    @property
    def interruption(self) -> str | None:
        """A clause about the interrupted training, if it is not complete."""
        if self.complete:
            return None
        return f"its training stopped at step {self.step}; 'bidnerf train' with --resume continues it"


def cameras_of(info: MapInfo) -> list[tuple[Intrinsics, SE3]]:
    """Return the cameras of the training images with their ``T_world_camera`` (float64)."""
    return [(c.intrinsics, c.pose) for c in info.cameras]


def longest_side(info: MapInfo) -> int | None:
    """Return the longer side of the largest training image, to which images were downscaled; None without cameras."""
    return max((max(c.intrinsics.width, c.intrinsics.height) for c in info.cameras), default=None)


def load_info(folder: Path) -> MapInfo:
    """Load and check ``map.json``. Raises ``InputError`` if it does not describe a map of this version."""
    path = folder / DESCRIPTION
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "no such folder"
        raise InputError(what, where=folder, expected="a map: a folder as written by 'bidnerf train'")
    if not path.exists():
        raise InputError(
            f"no {DESCRIPTION} found", where=folder, expected="a map as written by 'bidnerf train'"
        )
    found = read_json(path, "the description of a map")
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError("not the description of a map", where=path, expected=f'"format": "{FORMAT}"')
    if found.get("version") != VERSION:
        newer = isinstance(found.get("version"), int) and found["version"] > VERSION
        advice = "it was written by a newer bidnerf; upgrade bidnerf" if newer else "retrain the map"
        raise InputError(f"version {found.get('version')!r}", where=path, expected=f"{VERSION}; {advice}")
    info = from_plain(MapInfo, found, str(path))
    for name in (info.weights, info.training, info.surface, info.landmarks, info.capture, info.anchor):
        if name is not None and (not name or Path(name).name != name):
            raise InputError(f"names {name!r}", where=path, expected="the name of a file next to it")
    for name in with_wrong_pose(info.cameras):
        raise InputError(f"pose of camera {name!r} is not a rigid transform", where=path, expected="4x4 rows")
    return info
