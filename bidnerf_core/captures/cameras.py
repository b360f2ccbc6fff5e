"""Cameras of a map's training images, as stored in ``map.json`` and in the ``cameras.json`` of 3D Gaussian splatting."""

from __future__ import annotations

import json
import math
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.camera import Intrinsics, Orientation
from bidnerf_core.errors import InputError, InputWarning
from bidnerf_core.frames import View
from bidnerf_core.geometry import SE3, Similarity, scale_point
from bidnerf_core.io import read_json, write_file
from bidnerf_core.settings import LARGEST_LENGTH, Coordinate, Range, Settings

MatrixRows = tuple[tuple[float, float, float, float], ...]
"""The rows of a 4x4 matrix."""
Pixels = Annotated[float, Range(0, 1e6)]
RowMotion = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
"""A camera's motion while an image is read out (metres, then radians); see ``rolling_shutter``."""
INRIA_CAMERAS = "cameras.json"
"""Name of the file in which the original 3D Gaussian splatting code stores the training cameras."""


@dataclass(frozen=True)
class StoredCamera:
    """Camera and pose of a training image: a viewpoint from which the scene is known to be visible."""

    name: str
    intrinsics: Intrinsics
    T_world_camera: MatrixRows
    given_T_world_camera: MatrixRows | None = None  # the dataset's pose, if training refined it
    moved_pixels: Pixels | None = None  # median shift of the image's points by the refinement
    # camera motion from the first row to the last, if refinement estimated it
    motion: RowMotion | None = None
    file: str | None = None  # image file, relative to the folder of its dataset, if known
    orientation: Orientation | None = None  # how the image in the file was turned upright; None: not at all

    @property
    def pose(self) -> SE3:
        """T_world_camera, float64."""
        return _pose(self.T_world_camera)

    def scaled(self, factor: float) -> StoredCamera:
        """Return the camera with all lengths (positions and motion) multiplied by ``factor``."""

        def scale(rows: MatrixRows) -> MatrixRows:
            return (*((a, b, c, t * factor) for a, b, c, t in rows[:3]), rows[3])

        given = self.given_T_world_camera
        return replace(
            self,
            T_world_camera=scale(self.T_world_camera),
            given_T_world_camera=None if given is None else scale(given),
            motion=self.motion and (*scale_point(self.motion[:3], factor), *self.motion[3:]),
        )


@dataclass(frozen=True)
class MovedCamera:
    """How far refinement moved the camera of an image from its given pose."""

    name: str
    translation: float  # metres
    rotation_deg: float
    pixels: float  # median shift of points in the image
    motion: RowMotion | None = None  # camera motion from the first row of the image to the last

    def __str__(self) -> str:
        return f"{self.name} by {self.translation:.3g} and {self.rotation_deg:.2g}° or {self.pixels:.1f} px"


@dataclass(frozen=True)
class PoseRefinement(Settings):
    """How well the given and the adjusted poses fit the keypoints that images share, and which poses training used."""

    noise_before: Pixels  # standard deviation of reprojection errors at the given poses
    noise_after: Pixels
    refined: bool = False  # whether training used the adjusted poses
    replaced: tuple[str, ...] = ()  # images with a wrong given pose, localized with the others' landmarks

    @property
    def inconsistency(self) -> float:
        """Standard deviation (pixels) that errors of the given poses add to the keypoint noise."""
        return max(0.0, self.noise_before**2 - self.noise_after**2) ** 0.5


def poses_of(cameras: Sequence[StoredCamera]) -> SE3:
    """Return the poses T_world_camera of the cameras as a batch (n), float64."""
    return _pose([camera.T_world_camera for camera in cameras])


def stored_cameras(views: Sequence[View]) -> tuple[StoredCamera, ...]:
    """Convert training views to cameras as stored in ``map.json``."""
    return tuple(
        StoredCamera(
            v.frame.name,
            v.frame.intrinsics,
            _rows(v.T_ref_camera),
            motion=None if v.motion is None else (*v.motion.tolist(),),
        )
        for v in views
    )


def given_cameras(cameras: Sequence[StoredCamera]) -> tuple[StoredCamera, ...]:
    """Return the cameras at the poses given in the dataset, with names and intrinsics only."""
    return tuple(StoredCamera(c.name, c.intrinsics, c.given_T_world_camera or c.T_world_camera) for c in cameras)


def record_refinement(
    given: Sequence[View], refined: Sequence[StoredCamera], pixels: Sequence[float]
) -> tuple[StoredCamera, ...]:
    """Return the refined cameras, with the given pose and the shift ``pixels`` recorded where the pose changed."""
    return tuple(
        camera
        if camera.T_world_camera == (rows := _rows(view.T_ref_camera))
        else replace(camera, given_T_world_camera=rows, moved_pixels=moved)
        for view, camera, moved in zip(given, refined, pixels, strict=True)
    )


def cameras_with_invalid_pose(cameras: Sequence[StoredCamera]) -> list[str]:
    """Return the names of cameras whose given or refined pose is not a rigid transform, or is too far away."""
    poses = [(c.name, rows) for c in cameras for rows in (c.T_world_camera, c.given_T_world_camera) if rows]
    wrong = {name for name, rows in poses if len(rows) != 4}
    if poses and not wrong:
        matrices = torch.tensor([rows for _, rows in poses], dtype=torch.float64)
        is_near = (matrices[:, :3, 3].abs() <= LARGEST_LENGTH).all(dim=-1)
        sound = SE3.from_matrix(matrices).is_rigid() & is_near & (matrices[:, 3] == torch.eye(4)[3]).all(dim=-1)
        wrong = {name for (name, _), is_sound in zip(poses, sound.tolist(), strict=True) if not is_sound}
    return [camera.name for camera in cameras if camera.name in wrong]


def refinement_updates(cameras: Sequence[StoredCamera]) -> list[Float[Tensor, "6"] | None]:
    """Return the right updates (metres, then radians) from given to refined poses; None for unrefined poses."""
    if not cameras:
        return []
    updates = (poses_of(given_cameras(cameras)).inverse() @ poses_of(cameras)).log()
    return [update if camera.given_T_world_camera else None for camera, update in zip(cameras, updates, strict=True)]


def moved_cameras(cameras: Sequence[StoredCamera]) -> list[MovedCamera]:
    """Return how far refinement moved each camera whose pose it changed."""
    return [
        MovedCamera(c.name, float(u[:3].norm()), math.degrees(u[3:].norm()), c.moved_pixels or 0.0, c.motion)
        for c, u in zip(cameras, refinement_updates(cameras), strict=True)
        if u is not None
    ]


def pose_sentences(cameras: Sequence[StoredCamera], refinement: PoseRefinement) -> list[str]:
    """Return sentences on how consistent the given poses are and how far refinement moved them."""
    moved = sorted(moved_cameras(cameras), key=lambda m: m.pixels, reverse=True)
    wrong = [m for m in moved if m.name in refinement.replaced]
    motions = torch.tensor([camera.motion for camera in cameras if camera.motion], dtype=torch.float64)
    cause = "errors of the poses" + (" and camera motion during readout" if len(motions) else "")
    result = "the other poses are kept" if wrong else "the poses are kept"
    if refinement.refined and moved:
        metres, degrees, pixels = (
            median(getattr(m, name) for m in moved) for name in ("translation", "rotation_deg", "pixels")
        )
        result = (
            f"the poses are refined by {metres:.3g} and {degrees:.2g}° or {pixels:.1f} px (median), most for {moved[0]}"
        )
    lines = [
        f"{cause} amount to {refinement.inconsistency:.2f} px in the images, where keypoints alone scatter by"
        f" {refinement.noise_after:.2f} px; {result}"
    ]
    if len(motions):
        metres, radians = (median(part.norm(dim=-1).tolist()) for part in motions.split(3, dim=-1))
        lines.append(
            f"the images have a rolling shutter: during the readout the camera moved by {metres:.2g} and"
            f" {math.degrees(radians):.2g}° (median)"
        )
    if wrong:
        more = f" and {len(wrong) - 6} more" if len(wrong) > 6 else ""
        lines.append(
            f"moved to the poses given by the landmarks of the other images: {', '.join(map(str, wrong[:6]))}{more}"
        )
    return lines


def apply_stored_poses(views: Sequence[View], cameras: Sequence[StoredCamera]) -> list[View]:
    """Return the views with the refined poses and motions from ``cameras``, matched by name and, but for rounding, by given pose.

    Views whose pose was not refined are returned unchanged.
    """
    refined, applied = defaultdict[str, list[tuple[Tensor, StoredCamera]]](list), list[View]()
    for camera in cameras:
        if camera.given_T_world_camera:
            refined[camera.name].append((_pose(camera.given_T_world_camera).matrix(), camera))
    for view in views:
        own = view.T_ref_camera.matrix()
        same = (camera for given, camera in refined[view.frame.name] if torch.allclose(given, own, 1e-9, 1e-9))
        if (known := next(same, None)) is not None and not torch.equal(own, known.pose.matrix()):
            motion = None if known.motion is None else torch.tensor(known.motion, dtype=torch.float64)
            view = replace(view, T_ref_camera=known.pose, motion=motion)
        applied.append(view)
    return applied


def _rows(T: SE3) -> MatrixRows:
    return tuple(tuple(row) for row in T.matrix().tolist())


def _pose(rows: MatrixRows | Sequence[MatrixRows]) -> SE3:
    return SE3.from_matrix(torch.tensor(rows, dtype=torch.float64))


def write_inria_cameras(
    folder: Path, cameras: Sequence[StoredCamera], origin: Float[Tensor, "3"] | None = None
) -> list[Path]:
    """Write ``cameras.json`` to ``folder`` and return its path in a list; write nothing if there are no cameras.

    The positions of the cameras are relative to ``origin`` (world, by default 0), those in the file are not. The format
    stores no principal points; readers take the image centres instead.
    """
    if not cameras:
        return []
    rows = [
        {
            "id": number,
            "img_name": camera.name,
            "width": camera.intrinsics.width,
            "height": camera.intrinsics.height,
            "position": (camera.pose.translation if origin is None else camera.pose.translation + origin).tolist(),
            "rotation": camera.pose.rotation.tolist(),
            "fx": camera.intrinsics.fx,
            "fy": camera.intrinsics.fy,
        }
        for number, camera in enumerate(cameras)
    ]
    write_file(folder / INRIA_CAMERAS, (json.dumps(rows) + "\n").encode())
    return [folder / INRIA_CAMERAS]


def cameras_beside(path: Path, placement: Similarity) -> tuple[StoredCamera, ...]:
    """Read the ``cameras.json`` next to ``path`` or up to two folders above it, and transform the cameras by ``placement``.

    Returns no cameras if there is no such file. A damaged file, or one in another layout, is ignored with an ``InputWarning``.
    """
    file = next((f for folder in path.parents[:3] if (f := folder / INRIA_CAMERAS).is_file()), None)
    if file is None:
        return ()
    cameras = list[StoredCamera]()
    try:
        for entry in read_json(file, INRIA_CAMERAS):
            width, height = entry["width"], entry["height"]
            camera = Intrinsics(float(entry["fx"]), float(entry["fy"]), width / 2, height / 2, int(width), int(height))
            rotation, position = (torch.tensor(entry[key], dtype=torch.float64) for key in ("rotation", "position"))
            rows = _rows(SE3(placement.T_target_source.rotation.double() @ rotation, placement.apply(position)))
            cameras.append(StoredCamera(str(entry["img_name"]), camera, rows))
    except (InputError, KeyError, TypeError, ValueError, RuntimeError) as error:
        warnings.warn(
            f"{file}: camera {len(cameras)} is not readable in Inria's layout ({error}); ignored",
            InputWarning,
            stacklevel=2,
        )
        return ()
    return tuple(cameras)
