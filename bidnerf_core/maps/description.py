"""The description of a map: the content of its ``map.json``."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import torch

from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import PoseRefinement, StoredCamera, cameras_with_invalid_pose
from bidnerf_core.errors import InputError, InputWarning, enumeration
from bidnerf_core.fields import RadianceField, SceneBounds, scale_field
from bidnerf_core.geometry import SE3, LengthUnit, pose_from_matrix, scale_point
from bidnerf_core.installation import with_writer
from bidnerf_core.io import from_plain, read_json
from bidnerf_core.mapping import USUAL_FEATURES
from bidnerf_core.maps.description_file import DESCRIPTION, VERSION, read_description
from bidnerf_core.settings import (
    LARGEST_LENGTH,
    Above,
    Coordinate,
    Degrees,
    Length,
    NotNegative,
    Range,
    Settings,
    Share,
    WholeNumber,
)

PART_NAMES = ("weights", "training", "surface", "landmarks", "capture")
"""The keys of ``map.json`` whose values are file names."""
ANCHOR = "anchor.json"
LandmarkSource = Literal["photos", "rendered images"]
Scale = Annotated[float, Above(0, LARGEST_LENGTH)]


@dataclass(frozen=True)
class Anchor(Settings):
    """The location of a map on earth: a geodetic point, and the map's pose in the east-north-up frame at that point.

    Users may write an ``anchor.json`` next to ``map.json``; it overrides the key ``anchor`` until the map is
    saved.
    """

    latitude: Annotated[float, Range(-90, 90)]  # degrees
    longitude: Annotated[float, Range(-180, 180)]
    height: Annotated[float, Range(-1e6, 1e6)]  # metres above the WGS 84 ellipsoid
    # rows of the 4x4 matrix that maps the map's coordinates, times ``metres_per_unit``, to the east-north-up frame
    T_enu_world: tuple[tuple[float, ...], ...] = (
        (1.0, 0.0, 0.0, 0.0),
        (0.0, 1.0, 0.0, 0.0),
        (0.0, 0.0, 1.0, 0.0),
        (0.0, 0.0, 0.0, 1.0),
    )
    metres_per_unit: Scale = 1.0
    position_sigma: Length = 0.0  # of the anchor itself, along each axis; metres
    orientation_sigma: Degrees = 0.0  # about each axis

    def __post_init__(self) -> None:
        """Raise ``InputError`` for a value out of range, or a matrix that is not a rigid transform."""
        super().__post_init__()
        self.pose  # noqa: B018 (it checks the matrix)

    @cached_property
    def pose(self) -> SE3:
        """T_enu_world: the pose of the map's frame, scaled to metres, in the east-north-up frame at the anchor."""
        rows = [list(row) for row in self.T_enu_world]
        if [len(row) for row in rows] != [4] * 4:
            raise InputError(where="T_enu_world", expected="4 rows of 4 numbers")
        return pose_from_matrix(torch.tensor(rows, dtype=torch.float64), "T_enu_world")


@dataclass(frozen=True)
class FieldFrame(Settings):
    """The scale and bounds in which a map's field was trained, for a map that was scaled afterwards."""

    scale: Scale  # units of the map per unit of the field
    bounds: SceneBounds  # of the field, in its own unit


@dataclass(frozen=True)
class MapInfo:
    """The content of ``map.json``."""

    backend: str  # of the field; empty if the map has no field, not even an unfinished one
    config: dict[str, Any]
    bounds: SceneBounds
    step: WholeNumber  # training steps done; 0 in a map of landmarks alone, which has no field
    complete: bool  # whether training has finished
    data: str = ""  # name of the dataset's folder
    seconds: NotNegative = 0.0  # of training
    cameras: tuple[StoredCamera, ...] = ()
    pose_refinement: PoseRefinement | None = None  # of the cameras; None if nothing is known
    unit: LengthUnit = "units"  # of all lengths in the map; "units" if their length is unknown
    # Origin of the map's own coordinates, in the world frame of the poses passed to and returned by the map. All
    # positions in the map, such as those of its cameras and bounds, are relative to the origin, since single precision
    # resolves only decimetres in survey coordinates.
    origin: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    added: WholeNumber = 0  # number of cameras added after training, at the end of ``cameras``
    # upward direction (world), if the capture measured gravity
    gravity_up: tuple[Coordinate, Coordinate, Coordinate] | None = None
    field_frame: FieldFrame | None = None  # set if the map was scaled after training
    distances: bool = True  # False if all images are from one place and thus do not determine distances
    sparse_depth: WholeNumber = 0  # number of training pixels whose depth came from structure from motion
    hidden: WholeNumber = 0  # number of training pixels that masks hid
    weights: str = ""  # file names
    training: str | None = None  # the state needed to resume; dropped when training is complete
    surface: str | None = None  # baked from these weights
    landmarks: str | None = None
    landmark_source: LandmarkSource | None = None  # the images they were built from, if recorded
    landmark_features: str = USUAL_FEATURES  # name of the detector of their keypoints
    capture: str | None = None  # capture record of the photos the landmarks were built from
    anchor: Anchor | None = None  # where on earth the map lies, if known
    colour_noise: Share | None = None  # root mean square error of rendered colours on training images
    bidnerf: str = field(default_factory=lambda: version("bidnerf"))
    format: str = "bidnerf map"
    version: int = VERSION

    @property
    def interruption(self) -> str | None:
        """Where training stopped and how to resume it, as a clause; None if training is complete."""
        if self.complete:
            return None
        if not self.step:
            return "the training of its field has not begun; 'bidnerf train DATA --out MAP --resume' begins it"
        return (
            f"its training has not ended (step {self.step} is saved); 'bidnerf train DATA --out MAP --resume' continues it,"
            " and 'bidnerf train DATA --out MAP --finish' ends it as it is"
        )

    def scaled(self, factor: float, unit: LengthUnit) -> MapInfo:
        """Return the description of the map scaled by ``factor``, with lengths in ``unit``; the weights keep the unit of training."""
        frame = self.field_frame or FieldFrame(1.0, self.bounds)
        scale = frame.scale * factor
        return replace(
            self,
            bounds=frame.bounds if scale == 1 else self.bounds.scaled(factor),
            cameras=tuple(camera.scaled(factor) for camera in self.cameras),
            unit=unit,
            origin=scale_point(self.origin, factor),
            field_frame=None if scale == 1 else replace(frame, scale=scale),
            anchor=None
            if self.anchor is None
            else replace(self.anchor, metres_per_unit=self.anchor.metres_per_unit / factor),
        )

    def in_map_unit(self, field: RadianceField) -> RadianceField:
        """Return a field built by the backend, converted to the length unit of the map."""
        return field if self.field_frame is None else scale_field(field, self.field_frame.scale)


def cameras_of(info: MapInfo) -> list[tuple[Intrinsics, SE3]]:
    """Return the intrinsics and ``T_world_camera`` (float64, relative to the map's origin) of each training image."""
    return [(c.intrinsics, c.pose) for c in info.cameras]


def longest_side(info: MapInfo) -> int | None:
    """Return the longer side (pixels) of the largest training image after downscaling; None without cameras."""
    return max((max(c.intrinsics.width, c.intrinsics.height) for c in info.cameras), default=None)


def load_info(folder: Path) -> MapInfo:
    """Load and check ``map.json`` and any ``anchor.json``. Raises ``InputError`` unless they describe a map of this version."""
    path, found = folder / DESCRIPTION, read_description(folder)
    writer = found.get("bidnerf")
    for part in PART_NAMES:
        name = found.get(part)
        if isinstance(name, str) and (not name or Path(name).name != name):
            raise InputError(f"names {name!r}", where=path, expected="the name of a file next to it")
    if unknown := sorted(found.keys() - {part.name for part in fields(MapInfo)}):
        warnings.warn(
            f"{path}: ignored {enumeration(unknown)}, which bidnerf {version('bidnerf')} does not know; bidnerf {writer} wrote the map",
            InputWarning,
            stacklevel=2,
        )
        found = {key: value for key, value in found.items() if key not in unknown}
    # In parts, since a conversion takes several times the memory of its value.
    listed, cameras = found.get("cameras"), list[StoredCamera]()
    try:
        while isinstance(listed, list) and listed:
            cameras += from_plain(list[StoredCamera], listed[:1000], f"{path}: cameras")
            del listed[:1000]
        info = replace(from_plain(MapInfo, found, str(path)), cameras=tuple(cameras))
    except InputError as error:
        raise with_writer(error, writer) from error
    if (folder / ANCHOR).exists():
        info = replace(
            info, anchor=from_plain(Anchor, read_json(folder / ANCHOR, "the anchor of a map"), str(folder / ANCHOR))
        )
    for name in cameras_with_invalid_pose(info.cameras):
        raise InputError(
            f"pose of camera {name!r} is not a rigid transform",
            where=path,
            expected=f"4x4 rows, at most {LARGEST_LENGTH:g} from the origin",
        )
    return info
