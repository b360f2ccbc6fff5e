"""Meshes that trimesh reads, in any of its formats."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bidnerf_core.errors import InputError
from bidnerf_scan.scan import Scan, in_unit_range, joined

MOST_POINTS, MOST_COPIES = 2 * 10**8, 16
"""Points over all nodes, and in proportion to those of the meshes: a small mesh may be placed by any number of nodes."""
MOST_TEXELS = 2 * 10**9


def read(path: Path, expected: str, has_materials: bool = True) -> Scan:
    """Return all meshes of a file as one or, if it has none, its points; without ``has_materials``, only vertices have colours.

    The file's counts must have been checked. Raises ``InputError`` if trimesh cannot read it.
    """
    import trimesh

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(str(path), process=False)
            nodes = [(node, scene.geometry[scene.graph[node][1]]) for node in scene.graph.nodes_geometry]
            sizes = {id(geometry): len(getattr(geometry, "vertices", ())) for _, geometry in nodes}
            count = sum(sizes[id(geometry)] for _, geometry in nodes)
            most = min(MOST_POINTS, MOST_COPIES * sum(sizes.values()))
            parts = [] if count > most else [_placed(scene, node, has_materials) for node, _ in nodes]
    except (Exception, RecursionError) as error:  # trimesh raises whatever its parsing steps raise
        said = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        raise InputError(
            f"not readable ({said[:200]})", where=path, expected=f"{expected}; is it truncated?"
        ) from error
    if count > most:
        raise InputError(f"its nodes place {count:,} points", where=path, expected=f"at most {most:,}")
    meshes = [part for part in parts if part.faces is not None and len(part.faces)]
    chosen = meshes or [part for part in parts if len(part.points)]
    if not chosen:
        raise InputError("holds neither faces nor points", where=path, expected=expected)
    if sum(image.shape[0] * image.shape[1] for part in chosen for image in part.images) > MOST_TEXELS:
        raise InputError(f"textures of more than {MOST_TEXELS:,} pixels", where=path, expected="fewer")
    return joined(chosen)


def _placed(scene: Any, node: str, has_materials: bool) -> Scan:
    """Return the geometry of a node, in the coordinates of the file."""
    transform, name = scene.graph[node]
    geometry = scene.geometry[name]
    vertices = getattr(geometry, "vertices", np.zeros((0, 3)))
    points = np.asarray(vertices, np.float64) @ transform[:3, :3].T + transform[:3, 3]
    faces = getattr(geometry, "faces", None)
    if faces is None or not len(faces):
        return Scan(points, _vertex_colours(geometry, len(points)))
    faces = np.asarray(faces, np.int64)
    if geometry.visual.kind == "texture":
        return _textured(geometry.visual, points, faces, has_materials)
    if geometry.visual.kind == "face":
        rgb = in_unit_range(np.asarray(geometry.visual.face_colors)[:, :3])
        corners = np.arange(faces.size).reshape(faces.shape)
        return Scan(points[faces].reshape(-1, 3), rgb.repeat(3, axis=0), corners)
    return Scan(points, _vertex_colours(geometry, len(points)), faces)


def _vertex_colours(geometry: Any, count: int) -> NDArray[np.float32] | None:
    visual = getattr(geometry, "visual", None)
    if visual is None or visual.kind != "vertex":
        return None
    colours = np.asarray(visual.vertex_colors)
    return in_unit_range(colours[:, :3]) if len(colours) == count else None


def _textured(visual: Any, points: NDArray[np.float64], faces: NDArray[np.int64], has_materials: bool) -> Scan:
    """Return a mesh with a material: a texture, a colour, or both."""
    image, colour = _material(visual.material) if has_materials else (None, None)
    rgb = None if colour is None else np.broadcast_to(colour, (len(points), 3)).astype(np.float32)
    attributes = getattr(visual, "vertex_attributes", None)
    found = attributes.get("color") if attributes is not None else None
    if found is not None and len(found) == len(points):
        own = in_unit_range(np.asarray(found)[:, :3])
        rgb = own if rgb is None else rgb * own
    if image is None or visual.uv is None or len(visual.uv) != len(points):
        return Scan(points, rgb, faces)
    uv = np.asarray(visual.uv, np.float32)[faces][..., :2]
    return Scan(points, rgb, faces, uv, np.zeros(len(faces), np.int64), (image,))


def _material(material: Any) -> tuple[NDArray[np.uint8] | None, NDArray[np.float32] | None]:
    """Return the texture (h, w, 3) of a material and its colour (3,), if it has them."""
    texture = getattr(material, "baseColorTexture", None)
    texture = getattr(material, "image", None) if texture is None else texture
    image = None if texture is None else np.asarray(texture.convert("RGB"), np.uint8)
    factor = getattr(material, "baseColorFactor", None)
    if factor is None and image is None:
        factor = getattr(material, "diffuse", None)
    return image, None if factor is None else in_unit_range(np.asarray(factor)[:3])
