"""Maps in another length unit: scaling a whole map about the origin, and finding the factor that converts it
to metres.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.captures import CaptureReport, MatrixRows, RowMotion, StoredCamera
from bidnerf_core.errors import InputError, spelling_hint
from bidnerf_core.fields import (
    LARGEST_LENGTH,
    RadianceField,
    SceneBounds,
    VoxelGrid,
    device_of,
    render,
    scaled_field,
    trained_field,
)
from bidnerf_core.geometry import SE3, LengthUnit, fit_similarity, spread
from bidnerf_core.io import IMAGE_SUFFIXES
from bidnerf_core.localization import origin_of
from bidnerf_core.mapping import HeldOutTrial, LandmarkMap, SurfaceMap
from bidnerf_core.maps.anchor import scaled_anchor
from bidnerf_core.maps.description import FieldFrame, MapInfo

if TYPE_CHECKING:
    from bidnerf_core.maps.map import Map

log = logging.getLogger("bidnerf")

Position = Sequence[float] | Float[Tensor, "3"]
"""Three coordinates."""
Place = str | Position
"""A point of a map: its three coordinates, the name of one of its cameras, or ``NAME@U,V``, what that camera
shows at a pixel."""
DIGITS = re.compile(r"\d+|\.\w+$")
"""The parts in which the names of photos of one capture differ: numbers and file extensions."""
LEAST_CAMERAS = 3
"""Smallest number of cameras with known positions that gives a scale that can be checked."""
WORST_FIT = 0.2
"""Largest distance (root mean square) of scaled cameras from their known positions, relative to the spread of these."""


@dataclass(frozen=True)
class ScaleFit:
    """A factor that scales a map, and how well the cameras with known positions agree on it."""

    factor: float
    cameras: int
    error: float  # root mean square distance of the cameras from their known positions, in the unit of these

    def __str__(self) -> str:
        return f"factor {self.factor:.6g} from {self.cameras} cameras, which fit to {self.error:.3g} m (root mean square)"


def scaled(scene: Map, factor: float, unit: LengthUnit = "metres") -> Map:
    """Return the map with all lengths multiplied by ``factor``, in memory; ``unit`` is the resulting length
    unit.

    Raises ``InputError`` for a factor that is not positive or makes lengths too large, and for a map whose
    training is not complete.
    """
    if isinstance(factor, bool) or not (isinstance(factor, int | float) and 0 < factor < math.inf):
        raise InputError(f"factor is {factor!r}", expected="a positive number")
    where = scene.name
    if scene.info.interruption is not None:
        raise InputError(f"cannot be scaled: {scene.info.interruption}", where=where)
    if scene.unit == unit == "metres" and factor != 1:
        log.info("%s: was in metres before; its lengths are multiplied by %.6g all the same", where, factor)
    whole = scene.whole()
    extent = max(map(abs, (*scene.bounds.lower, *scene.bounds.upper, scene.bounds.far)))
    if not extent * factor <= LARGEST_LENGTH or not factor >= 1 / LARGEST_LENGTH:
        raise InputError(f"factor is {factor:g}, which makes the lengths of {where} too large or too small")
    capture = whole.capture
    info = scaled_info(whole.info, factor, unit)
    return replace(
        whole,
        info=info,
        field=in_map_frame(trained_field(whole.field), info),
        surface=None if whole.surface is None else scaled_surface(whole.surface, factor),
        landmarks=None if whole.landmarks is None else scaled_landmarks(whole.landmarks, factor),
        folder=None,
        record=None if capture is None else scaled_capture(capture, factor),
        anchor=None if whole.anchor is None else scaled_anchor(whole.anchor, factor),
    )


def in_map_frame(field: RadianceField, info: MapInfo) -> RadianceField:
    """Convert a field as its backend built it to the unit of its map."""
    return field if info.field_frame is None else scaled_field(field, info.field_frame.scale)


def scaled_info(info: MapInfo, factor: float, unit: LengthUnit) -> MapInfo:
    """Return the description of a map with lengths multiplied by ``factor``; weights stay in the unit of training."""
    frame = info.field_frame or FieldFrame(1.0, info.bounds)
    scale = frame.scale * factor
    bounds = frame.bounds if scale == 1 else scaled_bounds(info.bounds, factor)
    cameras, origin = tuple(_camera(camera, factor) for camera in info.cameras), _three(info.origin, factor)
    field_frame = None if scale == 1 else replace(frame, scale=scale)
    return replace(info, bounds=bounds, cameras=cameras, unit=unit, origin=origin, field_frame=field_frame)


def scaled_bounds(bounds: SceneBounds, factor: float) -> SceneBounds:
    """Return the bounds of a scene with lengths multiplied by ``factor``."""
    return replace(
        bounds, lower=_three(bounds.lower, factor), upper=_three(bounds.upper, factor), near=bounds.near * factor,
        far=bounds.far * factor, footprint=bounds.footprint * factor,
    )  # fmt: skip


def scaled_surface(surface: SurfaceMap, factor: float) -> SurfaceMap:
    """Return a surface with lengths multiplied by ``factor``; its index is unchanged."""
    parts, grid = surface.surfels, surface.grid
    surfels = replace(parts, positions=parts.positions * factor, rgb_gradient=parts.rgb_gradient / factor)
    moved = VoxelGrid(_three(grid.lower, factor), grid.cell * factor, grid.shape)
    keyframes = surface.keyframes.clone()
    keyframes[:, :3, 3] *= factor
    return replace(surface, surfels=surfels, index=replace(surface.index, grid=moved), keyframes=keyframes)


def scaled_landmarks(landmarks: LandmarkMap, factor: float) -> LandmarkMap:
    """Return landmarks with lengths multiplied by ``factor``."""
    lengths = landmarks.pose_covariance.new_tensor([factor] * 3 + [1.0] * 3)
    return replace(
        landmarks, positions=landmarks.positions * factor, deviations=landmarks.deviations * factor,
        sizes=landmarks.sizes * factor, pose_covariance=landmarks.pose_covariance * torch.outer(lengths, lengths),
        trial=_trial(landmarks.trial, factor),
    )  # fmt: skip


def scaled_capture(capture: CaptureReport, factor: float) -> CaptureReport:
    """Return a capture record with lengths multiplied by ``factor``."""
    photos = tuple(
        replace(
            photo, position=_three(photo.position, factor),
            pose_translation=None if photo.pose_translation is None else photo.pose_translation * factor,
        )
        for photo in capture.photos
    )  # fmt: skip
    coverage = replace(capture.coverage, centre=_three(capture.coverage.centre, factor))
    return replace(capture, photos=photos, coverage=coverage, trial=_trial(capture.trial, factor))


def factor_of_distance(scene: Map, first: Place, second: Place, metres: float) -> float:
    """Return the factor that makes the distance between two places ``metres``.

    Raises ``InputError`` for places that the map does not have or that coincide, and for a length that is not
    positive.
    """
    if not 0 < metres < math.inf:
        raise InputError(f"distance is {metres} m", expected="a positive length")
    apart = float(torch.linalg.vector_norm(place_of(scene, first) - place_of(scene, second)))
    if not apart > 0:
        raise InputError(f"{first} and {second} are the same place", expected="two different places")
    return metres / apart


def factor_of_poses(scene: Map, known: Mapping[str, SE3 | Position]) -> ScaleFit:
    """Return the factor by which the map's cameras fit ``known`` poses (T_world_camera) or positions, in
    metres in any world, matched by name.

    Only positions count. Raises ``InputError`` if fewer than three cameras are known, all are in one place,
    or they do not fit with any factor.
    """
    found = {name: camera for name in known if (camera := _camera_of(scene, name)) is not None}
    if len({camera.name for camera in found.values()}) < len(found):
        raise InputError("two known poses belong to the same camera of the map", expected="one for each")
    if len(found) < LEAST_CAMERAS:
        cameras = scene.info.cameras
        example = f" such as {cameras[0].name!r}" if cameras else ""
        raise InputError(
            f"{len(found)} of {len(known)} known poses belong to cameras of the map",
            expected=f"at least {LEAST_CAMERAS}, matched by name{example}",
        )
    source = torch.stack([camera.pose.translation for camera in found.values()])
    target = torch.stack([_position(known[name]) for name in found])
    fit = fit_similarity(source, target)
    off = float((fit.apply(source) - target).square().sum(-1).mean().sqrt())
    if off > WORST_FIT * spread(target):
        raise InputError(
            f"the cameras are {off:.3g} m (root mean square) from their known positions after the best"
            " scaling",
            expected="known positions of the same capture",
        )
    return ScaleFit(fit.scale, len(found), off)


def place_of(scene: Map, place: Place) -> Float[Tensor, "3"]:
    """Return the world coordinates of a place of the map (float64), see ``Place``. Raises ``InputError`` if it has none."""
    if not isinstance(place, str):
        return _position(place)
    if (camera := _camera_of(scene, place)) is not None:
        return camera.pose.translation + origin_of(scene)
    name, at, pixel = place.rpartition("@")
    numbers = _numbers(pixel)
    if at and len(numbers) == 2 and (camera := _camera_of(scene, name)) is not None:
        return _seen_at(scene, camera, numbers[0], numbers[1]) + origin_of(scene)
    if not at and len(numbers) == 3:
        return torch.tensor(numbers, dtype=torch.float64)
    raise InputError(f"no place {place!r} in the map: {_no_camera(scene, name if at else place)}")


def _position(place: SE3 | Position) -> Float[Tensor, "3"]:
    """Return a position, or that of a pose (float64). Raises ``InputError`` for anything but three coordinates."""
    given = place.translation if isinstance(place, SE3) else place
    point = torch.as_tensor(given, dtype=torch.float64).cpu()
    if point.shape != (3,) or not bool(point.isfinite().all()):
        raise InputError(f"place is {place!r}", expected="three coordinates")
    return point


def _camera_of(scene: Map, name: str) -> StoredCamera | None:
    """Return the camera with a name, which may end like an image file's, or None if there is none."""
    cameras = {camera.name: camera for camera in scene.info.cameras}
    stem = name[: -len(Path(name).suffix)] if name.lower().endswith(IMAGE_SUFFIXES) else name
    return cameras.get(name) or cameras.get(stem)


def _no_camera(scene: Map, name: str) -> str:
    """Return why a map has no camera of a photo, and what else names a place."""
    names = [camera.name for camera in scene.info.cameras]
    others = "NAME@U,V for what a camera shows at a pixel, or coordinates X,Y,Z"
    if not names:
        return "it has no cameras; expected coordinates X,Y,Z"
    alike = [each for each in names if DIGITS.sub("", each) == DIGITS.sub("", name)]
    if not alike:
        hint = spelling_hint(name, names, f", expected a name such as {names[0]!r}")
        return f"none of its {len(names)} cameras is called {name!r}{hint}; or give {others}"
    return (
        f"it has no camera of {name!r}; photos held out for tests are not in the map (every eighth, unless trained with --split"
        f" all), so take another, such as {alike[0]!r}, {others}"
    )


@torch.no_grad()
def _seen_at(scene: Map, camera: StoredCamera, u: float, v: float) -> Float[Tensor, "3"]:
    """Return the point that the field shows at a pixel of a camera."""
    if not (0 <= u <= camera.intrinsics.width and 0 <= v <= camera.intrinsics.height):
        size = f"{camera.intrinsics.width}x{camera.intrinsics.height}"
        raise InputError(f"pixel {u:g},{v:g} is outside {camera.name}, whose image in the map is {size}")
    ray = camera.intrinsics.unproject(torch.tensor([[u, v]], dtype=torch.float64))
    direction = camera.pose.rotate(ray / ray.norm(dim=-1, keepdim=True))
    origin = camera.pose.translation[None]
    device = device_of(scene.field)
    rays = scene.bounds.rays(origin.float().to(device), direction.float().to(device))
    shown = render(scene.field, rays, scene.bounds.background)
    if float(shown.opacity[0]) < 0.5:
        raise InputError(
            f"{camera.name}@{u:g},{v:g} shows the background", expected="a pixel that shows the scene"
        )
    return origin[0] + float(shown.distance[0] / shown.opacity[0]) * direction[0]


def _numbers(text: str) -> list[float]:
    try:
        found = [float(word) for word in text.split(",")]
    except ValueError:
        return []
    return found if all(map(math.isfinite, found)) else []


def _camera(camera: StoredCamera, factor: float) -> StoredCamera:
    given, motion = camera.given_T_world_camera, camera.motion
    return replace(
        camera, T_world_camera=_rows(camera.T_world_camera, factor),
        given_T_world_camera=None if given is None else _rows(given, factor),
        motion=None if motion is None else _motion(motion, factor),
    )  # fmt: skip


def _rows(rows: MatrixRows, factor: float) -> MatrixRows:
    return (*((a, b, c, t * factor) for a, b, c, t in rows[:3]), rows[3])


def _motion(motion: RowMotion, factor: float) -> RowMotion:
    a, b, c, d, e, f = motion
    return a * factor, b * factor, c * factor, d, e, f


def _trial(trial: HeldOutTrial, factor: float) -> HeldOutTrial:
    return replace(trial, translation=trial.translation * factor)


def _three(numbers: Sequence[float], factor: float) -> tuple[float, float, float]:
    x, y, z = numbers
    return x * factor, y * factor, z * factor
