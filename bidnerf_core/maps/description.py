"""The description of a map: the content of its ``map.json``."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import PoseRefinement, StoredCamera, with_wrong_pose
from bidnerf_core.errors import InputError
from bidnerf_core.fields import RadianceField, SceneBounds, scaled_field
from bidnerf_core.geometry import SE3, LengthUnit, multiplied
from bidnerf_core.io import from_plain, read_json
from bidnerf_core.mapping import USUAL_FEATURES
from bidnerf_core.maps.anchor import Anchor, load_anchor

VERSION = 1
DESCRIPTION = "map.json"
PART_NAMES = ("weights", "training", "surface", "landmarks", "capture")
"""The keys that name files."""
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

    backend: str  # of the field; empty if it has none and none was begun
    config: dict[str, Any]
    bounds: SceneBounds
    step: int  # training steps done; 0 in a map of landmarks alone, which has no field
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
    anchor: Anchor | None = None  # where on earth the map lies, if known
    colour_noise: float | None = None  # root mean square error of rendered colours on training images
    bidnerf: str = field(default_factory=lambda: version("bidnerf"))
    format: str = "bidnerf map"
    version: int = VERSION

    @property
    def interruption(self) -> str | None:
        """A clause about the interrupted training, if it is not complete."""
        if self.complete:
            return None
        if not self.step:
            return "the training of its field has not begun; 'bidnerf train' with --resume begins it"
        return f"its training stopped at step {self.step}; 'bidnerf train' with --resume continues it"

    def scaled(self, factor: float, unit: LengthUnit) -> MapInfo:
        """Return the description of the map with lengths multiplied by ``factor``; weights stay in the unit of training."""
        frame = self.field_frame or FieldFrame(1.0, self.bounds)
        scale = frame.scale * factor
        return replace(
            self,
            bounds=frame.bounds if scale == 1 else self.bounds.scaled(factor),
            cameras=tuple(camera.scaled(factor) for camera in self.cameras),
            unit=unit,
            origin=multiplied(self.origin, factor),
            field_frame=None if scale == 1 else replace(frame, scale=scale),
            anchor=None if self.anchor is None else self.anchor.scaled(factor),
        )

    def in_map_unit(self, field: RadianceField) -> RadianceField:
        """Convert a field as its backend built it to the unit of the map."""
        return field if self.field_frame is None else scaled_field(field, self.field_frame.scale)


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
    if not isinstance(found, dict) or found.get("format") != "bidnerf map":
        raise InputError("not the description of a map", where=path, expected='"format": "bidnerf map"')
    if found.get("version") != VERSION:
        newer = isinstance(found.get("version"), int) and found["version"] > VERSION
        advice = "it was written by a newer bidnerf; upgrade bidnerf" if newer else "retrain the map"
        raise InputError(f"version {found.get('version')!r}", where=path, expected=f"{VERSION}; {advice}")
    for part in (*PART_NAMES, "anchor"):
        name = found.get(part)
        if isinstance(name, str) and (not name or Path(name).name != name):
            raise InputError(f"names {name!r}", where=path, expected="the name of a file next to it")
    named = found.get("anchor")  # earlier versions named a file
    anchor = load_anchor(folder, named if isinstance(named, str) else "")
    info = from_plain(MapInfo, found | {"anchor": None if isinstance(named, str) else named}, str(path))
    if anchor is not None:
        info = replace(info, anchor=anchor)
    for name in with_wrong_pose(info.cameras):
        raise InputError(f"pose of camera {name!r} is not a rigid transform", where=path, expected="4x4 rows")
    return info
