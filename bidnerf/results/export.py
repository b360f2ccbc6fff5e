"""Export of a map for other software.

Surface, landmarks and cameras are written as point clouds, as a COLMAP model, or as ``transforms.json``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf.results.colmap_poses import write_colmap_model
from bidnerf.results.pose_files import LandmarkMatches, PosedImage, frame_of, write_pose_transforms
from bidnerf_core.captures import write_inria_cameras
from bidnerf_core.errors import InputError, UsageError, amount
from bidnerf_core.io import output_folder, write_file
from bidnerf_core.mapping import LandmarkMap
from bidnerf_core.maps import Map, load_info, load_map, origin_of
from bidnerf_core.progress import log
from bidnerf_core.registry import Plugins, interface_defects

Exporter: TypeAlias = Callable[[Map, Path], Sequence[Path]]
"""A function that writes a map, whose surface and landmarks are on the CPU, into an existing folder and returns the files.

Before writing anything, it raises ``InputError`` for a map that lacks what the format needs. Its attribute ``needs``, if it has one,
names parts ("surface", "landmarks") without which no map is loaded.
"""


EXPORTERS: Plugins[Exporter] = Plugins(
    "exporters",
    partial(interface_defects, attributes=(), methods={"__call__": ("scene", "out")}),
    first=("ply", "colmap", "transforms.json"),
)
"""The exporters, by the names of their formats."""


def export_map(scene: Map | str | Path, out: str | Path, to: str, overwrite: bool = False) -> list[Path]:
    """Export a map, given directly or by its folder, to folder ``out`` in a format of other software; return the files.

    - ``"ply"``: surface.ply (points with normals and colours), landmarks.ply (points with colours and the number of photos that show
      each) and cameras.ply (a pyramid for each camera), and cameras.json (the cameras in the format of 3D Gaussian splatting, which
      ``import`` uses as viewpoints of the surface);
    - ``"colmap"``: cameras.txt, images.txt and points3D.txt, where the points are the landmarks, and their tracks the keypoints
      from which they were built;
    - ``"transforms.json"``: the cameras in nerfstudio's format, and landmarks.ply as sparse points;
    - or an installed exporter, such as ``"splat.ply"`` of ``bidnerf-gaussians`` and ``"mesh.glb"`` of ``bidnerf-scan``.

    The first three use the world frame and unit of the map, stated in the headers, in double precision if its origin is not 0; installed
    exporters may write coordinates relative to that origin, see ``Map.origin``. Images are named by their files: relative to the folder of
    the dataset or, for COLMAP, to the folder that contains all of them. Cameras describe the images at the size that the map uses, which
    may be smaller than that of the files. Parts that the map lacks are left out.

    Raises ``InputError`` for an unknown format, for a map that has nothing to export, and for a folder that is not empty unless
    ``overwrite`` is set.
    """
    if to not in EXPORTERS:
        raise UsageError(f"format {to!r}", expected=f"one of {', '.join(EXPORTERS)}")
    write, out = EXPORTERS[to], Path(out)
    info = scene.info if isinstance(scene, Map) else load_info(Path(scene))
    for part in () if isinstance(scene, Map) else getattr(write, "needs", ()):
        if getattr(info, part) is None:
            raise InputError(f"has no {part}, which {to!r} needs; 'bidnerf bake' adds one", where=scene)
    with output_folder(out, overwrite):
        scene = (scene if isinstance(scene, Map) else load_map(scene)).whole()
        surface = None if scene.surface is None else scene.surface.to("cpu")
        landmarks = None if scene.landmarks is None else scene.landmarks.to("cpu")
        if surface is None and landmarks is None:
            log.info(f"{scene.name}: has neither a surface nor landmarks to export; 'bidnerf bake' makes both")
        return sorted(write(replace(scene, surface=surface, landmarks=landmarks), out))


def export_clouds(scene: Map, out: Path) -> list[Path]:
    """The surface, the landmarks and the cameras as point clouds and meshes."""
    images, files = _images(scene), list[Path]()
    if not images and scene.surface is None and scene.landmarks is None:
        raise InputError("has no surface, landmarks or cameras to export", where=scene.name)
    if scene.surface is not None:
        parts = scene.surface.surfels
        columns = {
            "x y z": _in_world(scene, parts.positions),
            "nx ny nz": parts.normals,
            "red green blue": parts.rgb,
        }
        files.append(out / "surface.ply")
        write_file(files[-1], ply(columns, head(scene, images, amount(len(parts), "surfel"))))
    if scene.landmarks is not None:
        files.append(_write_landmarks(scene, scene.landmarks, images, out))
    if images:
        corners, length = list[Tensor](), 0.03 * scene.bounds.side
        for image in images:  # each is drawn as a pyramid
            camera = image.intrinsics
            x, y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
            local = [[0.0, 0, 0], [-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]
            corners.append(image.T_world_camera.apply(length * torch.tensor(local, dtype=torch.float64)))
        one = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 3, 2], [1, 4, 3]])
        faces = (one[None] + 5 * np.arange(len(images))[:, None, None]).reshape(-1, 3)
        what = f"{amount(len(images), 'camera')}, five points each, the first of which is its centre"
        vertices = torch.cat(corners).to(torch.float64 if any(scene.origin) else torch.float32)
        files.append(out / "cameras.ply")
        write_file(files[-1], ply({"x y z": vertices}, head(scene, images, what), faces))
        files += write_inria_cameras(out, scene.info.cameras, origin_of(scene))
    return files


def export_colmap(scene: Map, out: Path) -> list[Path]:
    """A COLMAP text model: the cameras, the landmarks as 3D points, and as their tracks the keypoints they were built from."""
    images, landmarks, points = _images(scene, "colmap"), scene.landmarks, None
    folder = os.path.commonpath([os.path.dirname(image.name) for image in images])
    if landmarks is not None:
        positions = landmarks.positions.double() + origin_of(scene)
        colours = (_colours(scene, landmarks).clamp(0, 1) * 255).round().long()
        points = torch.arange(len(landmarks)), positions, colours
        if landmarks.tracks is None:
            log.info(f"{scene.name}: its landmarks have no tracks; 'bidnerf bake MAP --data DATA' finds them")
        else:
            for number, image in enumerate(images):
                own = landmarks.tracks.image == number
                seen, pixels = landmarks.tracks.landmark[own].long(), landmarks.tracks.pixel[own].double()
                images[number] = replace(image, matches=LandmarkMatches(pixels, seen, positions[seen]))
    images = [replace(image.as_stored, name=os.path.relpath(image.name, folder or ".")) for image in images]
    write_colmap_model(out / "images.txt", images, points)
    return [out / "cameras.txt", out / "images.txt", out / "points3D.txt"]


def export_transforms(scene: Map, out: Path) -> list[Path]:
    """A transforms.json: the cameras as nerfstudio reads them, with the landmarks as sparse points."""
    images, files = _images(scene, "transforms.json"), [out / "transforms.json"]
    more = {}
    if scene.landmarks is not None:
        files.append(_write_landmarks(scene, scene.landmarks, images, out))
        more["ply_file_path"] = files[-1].name
    write_pose_transforms(files[0], images, **more)
    return files


def _images(scene: Map, needed_by: str = "") -> list[PosedImage]:
    """Return the images of a map. Raises ``InputError`` for a map without images if the format ``needed_by`` needs some."""
    images = [
        PosedImage(
            camera.file or camera.name,
            number,
            camera.intrinsics,
            camera.pose.translated(origin_of(scene)),
            unit=scene.unit,
            orientation=camera.orientation,
        )
        for number, camera in enumerate(scene.info.cameras)
    ]
    if needed_by and not images:
        raise InputError(f"has no cameras, but {needed_by} needs some; ply does not", where=scene.name)
    return images


def _in_world(scene: Map, positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return positions of the map's parts in world coordinates, in double precision if the map has a nonzero origin."""
    return positions.double() + origin_of(scene) if any(scene.origin) else positions


def _write_landmarks(scene: Map, landmarks: LandmarkMap, images: list[PosedImage], out: Path) -> Path:
    columns = {
        "x y z": _in_world(scene, landmarks.positions),
        "red green blue": _colours(scene, landmarks),
        "photos": landmarks.views,
    }
    write_file(out / "landmarks.ply", ply(columns, head(scene, images, amount(len(landmarks), "landmark"))))
    return out / "landmarks.ply"


def ply(columns: dict[str, Tensor], comments: list[str], faces: np.ndarray | None = None) -> bytes:
    """Return a binary PLY of points, with triangles if there are ``faces``.

    The keys of ``columns`` are the names of properties, separated by spaces, and the values have one row per
    point. Colours in [0, 1] are written as bytes, integers with 32 bits, and other numbers in their own
    precision.
    """
    kinds, values = dict[str, str](), list[np.ndarray]()
    for names, column in columns.items():
        table = column.detach().cpu().reshape(len(column), -1).numpy()
        kind = {"f4": "float", "f8": "double"}.get(table.dtype.str[1:], "int")
        if names == "red green blue":
            table, kind = (table.clip(0, 1) * 255).round(), "uchar"
        kinds |= dict.fromkeys(names.split(), kind)
        values += list(table.T)
    stored = {"uchar": "u1", "float": "<f4", "double": "<f8", "int": "<i4"}
    rows = np.rec.fromarrays(values, dtype=[(name, stored[kind]) for name, kind in kinds.items()])
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    lines += [f"element vertex {len(rows)}", *(f"property {kind} {name}" for name, kind in kinds.items())]
    body = rows.tobytes()
    if faces is not None:
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        listed = np.empty(len(faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
        listed["count"], listed["corners"] = 3, faces
        body += listed.tobytes()
    return "\n".join([*lines, "end_header", ""]).encode() + body


def head(scene: Map, images: Sequence[PosedImage], what: str) -> list[str]:
    """Return the header comments of a file: content, unit of lengths, up direction, and frame of the images."""
    lengths = "metres" if scene.unit == "metres" else "units of unknown length"
    up = "" if scene.up is None else f"up is {' '.join(f'{x:.6f}' for x in scene.up.direction)}, by {scene.up.source}"
    lines = ("written by bidnerf", what, f"lengths in {lengths}", up, frame_of(images) if images else "")
    return [line for line in lines if line]


def _colours(scene: Map, landmarks: LandmarkMap) -> Float[Tensor, "n 3"]:
    """Return the colours of the landmarks, taken from the nearest surfels; grey without a surface."""
    if scene.surface is None:
        return torch.full((len(landmarks), 3), 0.5)
    return scene.surface.surfels.rgb[scene.surface.nearest(landmarks.positions)]
