"""Exporters of the surface of a map as a coloured mesh."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from bidnerf.results import head, ply
from bidnerf_core.captures import StoredCamera, write_inria_cameras
from bidnerf_core.errors import InputError, amount
from bidnerf_core.io import write_file
from bidnerf_core.maps import Map
from bidnerf_scan.meshing import Mesh, mesh_of_surface

T_WORLD_FILE = "T_world_file.json"
"""Name of the file with the pose that takes the coordinates of a mesh to the world, for ``import --T-world-file``."""


def export_ply(scene: Map, out: Path) -> list[Path]:
    """The surface as a coloured mesh in PLY, in the frame of the map."""
    mesh, file = _mesh(scene), out / "mesh.ply"
    _remove_others(out)
    columns = {"x y z": mesh.points, "nx ny nz": mesh.normals, "red green blue": mesh.rgb}
    tensors = {names: torch.from_numpy(column) for names, column in columns.items()}
    write_file(file, ply(tensors, head(scene, [], _content(mesh)), mesh.faces))
    return [file, *write_inria_cameras(out, scene.info.cameras)]


def export_glb(scene: Map, out: Path) -> list[Path]:
    """The surface as a coloured mesh in binary glTF, with y upwards, and the pose that turns it back."""
    return _export_upright(scene, out, "glb")


def export_obj(scene: Map, out: Path) -> list[Path]:
    """The surface as a coloured mesh in OBJ, with y upwards, and the pose that turns it back."""
    return _export_upright(scene, out, "obj")


for _exporter in (export_ply, export_glb, export_obj):
    vars(_exporter)["needs"] = ("surface",)  # known before the map is loaded


def _mesh(scene: Map) -> Mesh:
    if scene.surface is None:
        raise InputError("has no surface, from which a mesh could be made; 'bidnerf bake' adds one", where=scene.name)
    return mesh_of_surface(scene.surface)


def _remove_others(out: Path) -> None:
    """Remove earlier meshes from the folder, since the cameras beside a mesh are turned as it is."""
    for name in ("mesh.ply", "mesh.glb", "mesh.obj", T_WORLD_FILE):
        (out / name).unlink(missing_ok=True)


def _content(mesh: Mesh) -> str:
    return f"{amount(len(mesh.faces), 'triangle')}, on a grid with cells of {mesh.cell:.3g}"


def _export_upright(scene: Map, out: Path, ending: str) -> list[Path]:
    """Write a mesh in a format whose y axis is upwards."""
    import trimesh

    mesh, turn = _mesh(scene), _y_upwards(scene)
    _remove_others(out)
    content = head(scene, [], _content(mesh))
    if scene.up is not None:
        content.append(f"turned so that y is upwards; {T_WORLD_FILE} turns it back to the frame of the map")
    turned = trimesh.Trimesh(
        mesh.points @ turn.T,
        mesh.faces,
        vertex_normals=mesh.normals @ turn.T.astype(np.float32),
        vertex_colors=(255 * mesh.rgb).round().astype(np.uint8),
        process=False,
    )
    turned.metadata["comments"] = content
    options = {"header": "\n# ".join(content)} if ending == "obj" else {}
    file, pose = out / f"mesh.{ending}", out / T_WORLD_FILE
    written = turned.export(file_type=ending, **options)
    write_file(file, written.encode() if isinstance(written, str) else written)
    T_world_file = np.eye(4)
    T_world_file[:3, :3] = turn.T
    write_file(pose, (json.dumps(T_world_file.tolist()) + "\n").encode())
    cameras = [_turned(camera, turn) for camera in scene.info.cameras]
    return [file, pose, *write_inria_cameras(out, cameras)]


def _turned(camera: StoredCamera, turn: Float64[np.ndarray, "3 3"]) -> StoredCamera:
    rotation = np.eye(4)
    rotation[:3, :3] = turn
    rows = (rotation @ np.array(camera.T_world_camera)).tolist()
    return replace(camera, T_world_camera=tuple((r[0], r[1], r[2], r[3]) for r in rows))


def _y_upwards(scene: Map) -> Float64[np.ndarray, "3 3"]:
    """Return the smallest rotation that takes the map's upward direction, if it has one, to the y axis."""
    if scene.up is None:
        return np.eye(3)
    up = np.asarray(scene.up.direction, dtype=np.float64)
    axis = np.cross(up, [0.0, 1.0, 0.0])
    sine = np.linalg.norm(axis)
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    found: Float64[np.ndarray, "3 3"] = Rotation.from_rotvec(np.arctan2(sine, up[1]) * axis).as_matrix()
    return found
