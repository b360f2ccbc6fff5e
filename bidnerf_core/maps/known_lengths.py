"""Finding the factor that converts a map's lengths to metres, from a known distance or known camera positions."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.captures import StoredCamera
from bidnerf_core.datasets import numbers_in
from bidnerf_core.errors import InputError, spelling_hint
from bidnerf_core.fields import (
    device_of,
    render,
)
from bidnerf_core.geometry import SE3, fit_similarity, spread
from bidnerf_core.io import IMAGE_SUFFIXES
from bidnerf_core.maps.map import Map
from bidnerf_core.maps.scene import origin_of

Position = Sequence[float] | Float[Tensor, "3"]
"""Three coordinates (x, y, z)."""
Place = str | Position
"""A point of a map: three coordinates, the name of a camera of the map (its centre), or ``NAME@U,V``, the
point that a camera shows at pixel (U, V)."""


@dataclass(frozen=True)
class ScaleFit:
    """A factor that scales a map, and how well the cameras with known positions agree on it."""

    factor: float
    cameras: int
    error: float  # root mean square distance of the cameras from their known positions, in the unit of these

    def __str__(self) -> str:
        return (
            f"factor {self.factor:.6g} from {self.cameras} cameras, which fit to {self.error:.3g} m (root mean square)"
        )


def factor_of_distance(scene: Map, first: Place, second: Place, metres: float) -> float:
    """Return the scale factor that makes the distance between two points of the map equal ``metres``.

    Raises ``InputError`` for points that the map does not have or that coincide, and for a length that is not
    positive.
    """
    if not 0 < metres < math.inf:
        raise InputError(f"distance is {metres} m", expected="a positive length")
    distance = float(torch.linalg.vector_norm(locate_point(scene, first) - locate_point(scene, second)))
    if not distance > 0:
        raise InputError(f"{first} and {second} are the same place", expected="two different places")
    return metres / distance


def factor_of_poses(scene: Map, known: Mapping[str, SE3 | Position]) -> ScaleFit:
    """Return the scale factor that best fits the map's cameras to ``known`` poses (T_world_camera) or positions.

    The poses or positions are in metres, in any world frame, and matched by name; only positions are used.
    Raises ``InputError`` if fewer than three cameras are known, if all are at one position, or if no factor
    fits them.
    """
    found = {name: camera for name in known if (camera := _camera_of(scene, name)) is not None}
    if len({camera.name for camera in found.values()}) < len(found):
        raise InputError("two known poses belong to the same camera of the map", expected="one for each")
    if len(found) < 3:  # two give a scale that cannot be checked
        cameras = scene.info.cameras
        raise InputError(
            f"{len(found)} of {len(known)} known poses belong to cameras of the map",
            expected="at least 3, matched by name" + (f" such as {cameras[0].name!r}" if cameras else ""),
        )
    source = torch.stack([camera.pose.translation for camera in found.values()])
    target = torch.stack([_position(known[name]) for name in found])
    fit = fit_similarity(source, target)
    error = float((fit.apply(source) - target).square().sum(-1).mean().sqrt())
    # A misfit that is large relative to the spread of the positions indicates another capture.
    if error > 0.2 * spread(target):
        raise InputError(
            f"the cameras are {error:.3g} m (root mean square) from their known positions after the best scaling",
            expected="known positions of the same capture",
        )
    return ScaleFit(fit.scale, len(found), error)


def locate_point(scene: Map, point: Place) -> Float[Tensor, "3"]:
    """Return the world coordinates (float64) of a point of the map, see ``Place``. Raises ``InputError`` for an unknown point."""
    if not isinstance(point, str):
        return _position(point)
    if (camera := _camera_of(scene, point)) is not None:
        return camera.pose.translation + origin_of(scene)
    name, at, pixel = point.rpartition("@")
    numbers = list[float]()
    with contextlib.suppress(InputError):
        numbers = numbers_in(point, pixel, 2 if at else 3)
    if numbers and not at:
        return torch.tensor(numbers, dtype=torch.float64)
    if numbers and (camera := _camera_of(scene, name)) is not None:
        return _seen_at(scene, camera, *numbers) + origin_of(scene)
    missing, names = name if at else point, [camera.name for camera in scene.info.cameras]
    if not names:
        raise InputError(f"no place {point!r} in the map: it has no cameras; expected coordinates X,Y,Z")
    hint = spelling_hint(missing, names, f", expected a name such as {names[0]!r}")
    raise InputError(
        f"no place {point!r} in the map: none of its {len(names)} cameras is called {missing!r}{hint} (photos held out"
        " for tests, every eighth unless `split` was all in the training, are not in the map); or give NAME@U,V for what a"
        " camera shows at a pixel, or coordinates X,Y,Z"
    )


def _position(given: SE3 | Position) -> Float[Tensor, "3"]:
    """Return a position, or the position of a pose (float64). Raises ``InputError`` unless it has three coordinates."""
    point = torch.as_tensor(given.translation if isinstance(given, SE3) else given, dtype=torch.float64).cpu()
    if point.shape != (3,) or not bool(point.isfinite().all()):
        raise InputError(f"place is {given!r}", expected="three coordinates")
    return point


def _camera_of(scene: Map, name: str) -> StoredCamera | None:
    """Return the camera called ``name``, or the only camera whose name ends with ``name``; None if there is no such camera.

    ``name`` may include the extension of an image file.
    """
    cameras = {camera.name: camera for camera in scene.info.cameras}
    stem = name[: -len(Path(name).suffix)] if name.lower().endswith(IMAGE_SUFFIXES) else name
    ending = [camera for each, camera in cameras.items() if stem and each.endswith(stem)]
    return cameras.get(name) or cameras.get(stem) or (ending[0] if len(ending) == 1 else None)


@torch.no_grad()
def _seen_at(scene: Map, camera: StoredCamera, u: float, v: float) -> Float[Tensor, "3"]:
    """Return the point (float64, relative to the map's origin) that the field shows at a pixel of a camera.

    Raises ``InputError`` for a pixel outside the image or on the background.
    """
    if not (0 <= u <= camera.intrinsics.width and 0 <= v <= camera.intrinsics.height):
        raise InputError(
            f"pixel {u:g},{v:g} is outside {camera.name}, whose image in the map is"
            f" {camera.intrinsics.width}x{camera.intrinsics.height}"
        )
    ray = camera.intrinsics.unproject(torch.tensor([[u, v]], dtype=torch.float64))
    direction = camera.pose.rotate(ray / ray.norm(dim=-1, keepdim=True))
    origin = camera.pose.translation[None]
    device = device_of(scene.field)
    shown = render(
        scene.field,
        scene.bounds.rays(origin.float().to(device), direction.float().to(device)),
        scene.bounds.background,
    )
    if float(shown.opacity[0]) < 0.5:
        raise InputError(f"{camera.name}@{u:g},{v:g} shows the background", expected="a pixel that shows the scene")
    return origin[0] + float(shown.distance[0] / shown.opacity[0]) * direction[0]
