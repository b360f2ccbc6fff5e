"""JSON values with which the page shows trajectories and a map: its surface, landmarks, and cameras with thumbnails."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from bidnerf.results import pose_entries, standard_deviations
from bidnerf.viewer.pictures import (
    JsonObject,
    jpeg_json,
    pack,
    pack_colours,
    pack_points,
    quick_image,
)
from bidnerf_core.camera import Intrinsics
from bidnerf_core.captures import StoredCamera, poses_of
from bidnerf_core.datasets import read_trajectory
from bidnerf_core.devices import move_to
from bidnerf_core.errors import InputError
from bidnerf_core.fields import SplatField
from bidnerf_core.geometry import SE3, LengthUnit, pose_from_matrix, symbol
from bidnerf_core.io import read_file
from bidnerf_core.maps import Map
from bidnerf_core.progress import log

MOST_POINTS = 120_000
"""Maximum number of surfels or splats in a page; larger sets are subsampled at random."""


def map_json(scene: Map, thumbnails: int = 60) -> JsonObject:
    """Return the JSON values of a map; ``thumbnails`` is the maximum number of cameras with a rendered thumbnail.

    ``unit`` is the symbol of the unit of length, ``up_source`` states how the upward direction ``up`` was found, and
    ``centre`` and ``extent`` (in the unit of the map) are those of the region that the initial view should show.
    """
    up, (centre, extent), landmarks = scene.up, _framing(scene), scene.landmarks
    some = _subset(0 if landmarks is None else len(landmarks), 20_000)
    every = max(1, math.ceil(len(scene.info.cameras) / max(thumbnails, 1)))
    return {
        "name": "map in memory" if scene.folder is None else os.path.basename(os.path.abspath(scene.folder)),
        "facts": _facts(scene),
        "unit": symbol(scene.unit),
        "up": (0.0, 0.0, 1.0) if up is None else up.direction,
        "up_source": "not known" if up is None else up.source,
        "centre": centre,
        "extent": extent,
        "surface": _surface(scene),
        "landmarks": None if landmarks is None else _points(landmarks.positions[some], len(landmarks), 0.0),
        "splats": _splats(scene),
        "cameras": [
            {
                "name": camera.name,
                "pose": matrix_rows(camera.pose),
                "shape": frustum(camera.intrinsics),
                "thumbnail": jpeg_json(thumbnail(scene, camera)) if thumbnails and number % every == 0 else None,
            }
            for number, camera in enumerate(scene.info.cameras)
        ],
    }


def frustum(camera: Intrinsics) -> JsonObject:
    """Return a camera's viewing frustum without lens distortion: its sides on the plane z = 1, and the image size (pixels)."""
    return {
        "left": -camera.cx / camera.fx,
        "right": (camera.width - camera.cx) / camera.fx,
        "top": -camera.cy / camera.fy,
        "bottom": (camera.height - camera.cy) / camera.fy,
        "width": camera.width,
        "height": camera.height,
    }


def thumbnail(scene: Map, camera: StoredCamera) -> Float[Tensor, "h w 3"]:
    """Render a small image from a camera of the map."""
    return quick_image(scene, camera.intrinsics.at_most(80), camera.pose)  # pixels on the longer side


def matrix_rows(T: SE3) -> tuple[float, ...]:
    """Return a pose as the 16 numbers of its matrix, row by row."""
    return tuple(T.matrix().detach().cpu().double().flatten().tolist())


def _facts(scene: Map) -> tuple[tuple[str, str], ...]:
    up, surfels = scene.up, 0 if scene.surface is None else len(scene.surface.surfels)
    offset = (("origin", "positions shown here are relative to ({:,.0f}, {:,.0f}, {:,.0f})".format(*scene.origin)),)
    landmarks = 0 if scene.landmarks is None else len(scene.landmarks)
    return (
        ("backend", scene.info.backend if scene.has_field else "no field; landmarks alone"),
        ("images", f"{len(scene.info.cameras):,}"),
        ("surface", f"{surfels:,} surfels" if surfels else "not baked"),
        ("landmarks", f"{landmarks:,}" if landmarks else "none"),
        ("lengths", "metres" if scene.unit == "metres" else "units of the map; no scale is known"),
        ("up", "not known" if up is None else f"from {up.source}"),
        *(offset if any(scene.origin) else ()),
    )


def _points(
    points: Float[Tensor, "n 3"],
    count: int,
    radius: float,
    colours: JsonObject | None = None,
    sizes: JsonObject | None = None,
    normals: JsonObject | None = None,
) -> JsonObject:
    """Return the JSON values of a subset of a map's points; ``count`` is the number of all points.

    The radius of each point is ``radius``, in the map's unit, times the point's entry in ``sizes``, float32 (n), if
    given. The ``normals``, int8 (n, 3) scaled by 127, point turn_towards the cameras, since back faces are culled.
    """
    return {
        "points": pack_points(points),
        "count": count,
        "radius": radius,
        "colours": colours,
        "sizes": sizes,
        "normals": normals,
    }


def _surface(scene: Map) -> JsonObject | None:
    if scene.surface is None:
        return None
    surfels = scene.surface.surfels
    some = _subset(len(surfels), MOST_POINTS)  # in random order, so that the first ones show the whole
    radius = scene.surface.cell * max(1.0, (len(surfels) / max(len(some), 1)) ** 0.5) / 2
    positions, keyframes = surfels.positions[some].cpu(), scene.surface.keyframes[:, :3, 3].cpu()
    normals = turn_towards(positions, surfels.normals[some].cpu(), keyframes)
    return _points(
        positions,
        len(surfels),
        radius,
        pack_colours(surfels.rgb[some]),
        normals=pack((127 * normals).round().to(torch.int8).numpy()),
    )


def turn_towards(
    positions: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], cameras: Float[Tensor, "k 3"]
) -> Float[Tensor, "n 3"]:
    """Return normals flipped turn_towards the nearest camera, so that back-face culling lets one see into a room from outside."""
    if not len(cameras):
        return normals
    _, nearest = cKDTree(cameras.numpy()).query(positions.numpy())
    ahead = ((cameras[torch.from_numpy(nearest)] - positions) * normals).sum(-1, keepdim=True)
    return torch.where(ahead < 0, -normals, normals)


def _splats(scene: Map) -> JsonObject | None:
    """Return the splats of the field, except nearly transparent ones, as points with their own radii."""
    if not isinstance(scene.field, SplatField):
        return None
    splats = move_to(scene.field.splats(), "cpu")
    seen = (splats.opacity >= 0.2).nonzero()[:, 0]
    some = seen[_subset(len(seen), MOST_POINTS)]
    return _points(
        splats.positions[some],
        len(splats.positions),
        1.0,
        pack_colours(splats.rgb[some]),
        pack(splats.radius[some].float().numpy()),
    )


def _subset(count: int, most: int) -> Tensor:
    """Return the indices of at most ``most`` of ``count`` elements, drawn at random with a fixed seed."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))[:most]


def _framing(scene: Map) -> tuple[Sequence[float], float]:
    """Return the centre of a scene, and the size that encloses most of it, in the unit of the map."""
    parts = (None if scene.surface is None else scene.surface.surfels, scene.landmarks)
    clouds = [part.positions for part in parts if part is not None and len(part)]
    if not clouds:
        return scene.bounds.centre, max(scene.bounds.size)
    points = clouds[0][_subset(len(clouds[0]), 20_000)].cpu().double()
    if scene.info.cameras:  # weighted so that all cameras together count as a hundredth of the points
        places = poses_of(scene.info.cameras).translation
        points = torch.cat([points, places.repeat(1 + len(points) // (100 * len(places)), 1)])
    low, high = (points.quantile(q, dim=0) for q in (0.01, 0.99))  # a few points may be far away
    return ((low + high) / 2).tolist(), max(float((high - low).max()), 1e-9)


# Trajectories.


def trajectory_json(
    path: Path, unit: LengthUnit | None = None, origin: Sequence[float] = (0.0, 0.0, 0.0)
) -> JsonObject:
    """Read a trajectory: a JSON file of 'bidnerf track' or 'localize', which has uncertainties, or a TUM, EuRoC or KITTI file.

    The poses are shown relative to ``origin``, the origin of the map. A remark is logged if the file states a unit
    other than the map's ``unit``. Raises ``InputError`` for a file without poses.

    In the result, ``poses`` are T_world_camera without the last row, float32 (n, 12). Each pose has a frame name in
    ``frames``, a time in seconds, a standard deviation of the position (in the file's unit) in ``sigmas``, and an
    outcome. Values that the file does not state are None or an empty string.
    """
    content = read_file(path, "a trajectory")
    if path.suffix.lower() in (".json", ".jsonl"):
        entries = [
            each for each in pose_entries(path, content) if isinstance(each, dict) and each.get("T_world_camera")
        ]
        poses = [_read_pose(entry, path) for entry in entries]
    else:
        rows = read_trajectory(path)
        stated = re.search(rb"^#.*lengths in (metres|units)", content.partition(b"\n")[0])  # by bidnerf
        of = None if stated is None else stated[1].decode()
        columns = zip(rows.times.tolist(), rows.rotations, rows.translations, strict=True)
        poses = [(SE3(rotation, translation), "", time, None, "", of) for time, rotation, translation in columns]
    if not poses:
        raise InputError("holds no pose", where=path, expected="those of a trajectory")
    some = poses[:: max(1, math.ceil(len(poses) / 20_000))]  # longer ones are subsampled at a regular stride
    T, frames, times, sigmas, outcomes, _ = zip(*some, strict=True)
    other = {each[-1] for each in poses} - {unit, None}
    if unit is not None and other:
        log.info("%s: is in %s, but the map is in %s; its poses are shown as they are", path, other.pop(), unit)
    return {
        "name": path.name,
        "poses": pack(SE3.stack(list(T)).translated(-torch.tensor(origin).double()).matrix()[:, :3].flatten(1).numpy()),
        "frames": frames,
        "times": times,
        "sigmas": sigmas,
        "outcomes": outcomes,
    }


def _read_pose(entry: dict[str, Any], path: Path) -> tuple[SE3, str, float | None, float | None, str, str | None]:
    """Return a pose, the name and time (seconds) of its frame, the position's standard deviation, the outcome, and the unit of length."""
    covariance, time, unit, sigma = entry.get("covariance"), entry.get("time"), entry.get("unit"), math.nan
    try:
        rows = torch.tensor(entry["T_world_camera"], dtype=torch.float64)
        if covariance is not None:
            sigma = standard_deviations(torch.tensor(covariance, dtype=torch.float64).reshape(6, 6))[0]
        time = None if time is None else float(time)
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise InputError(f"{entry.get('frame')!r} has no matrices of numbers", where=path, expected="poses") from error
    return (
        pose_from_matrix(rows, "T_world_camera", path),
        str(entry.get("frame", "")),
        time,
        sigma if math.isfinite(sigma) else None,
        str(entry.get("outcome", "")),
        unit if isinstance(unit, str) else None,
    )
