"""glTF, binary or with separate buffers, read by trimesh."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from bidnerf_core.errors import InputError
from bidnerf_core.io import open_binary
from bidnerf_scan.formats import by_trimesh
from bidnerf_scan.scan import Scan

EXPECTED = "a glTF file of a mesh or of points"
COMPRESSED = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")
SPLATS = "KHR_gaussian_splatting"
LARGEST_JSON = 256 * 2**20
DEEPEST = 200
"""Nodes below each other; skeletons and assemblies have some tens."""
BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
NUMBERS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def recognises(path: Path) -> bool:
    """Return whether the file is a glTF without Gaussian splats."""
    if path.suffix.lower() not in (".glb", ".gltf"):
        return False
    try:
        return SPLATS not in (_content(path).get("extensionsUsed") or ())
    except InputError:  # reported when it is read
        return True


def read(path: Path) -> Scan:
    """Return the mesh or the points of a glTF file, with the transforms of its nodes."""
    content = _content(path)
    needed = [name for name in COMPRESSED if name in (content.get("extensionsUsed") or ())]
    if needed:
        raise InputError(
            f"is compressed ({needed[0]}), which is not supported",
            where=path,
            expected="glTF without compression (`gltf-transform copy` or Blender write it)",
        )
    _check_counts(path, content)
    _check_depth(path, content)
    return by_trimesh.read(path, EXPECTED)


def _content(path: Path) -> dict[str, Any]:
    """Return the JSON of a file. Raises ``InputError`` for a damaged or truncated one."""
    size = path.stat().st_size
    with open_binary(path, EXPECTED) as file:
        text: bytes
        if path.suffix.lower() == ".glb":
            head = file.read(20)
            if len(head) < 20 or head[:4] != b"glTF":
                raise InputError("no binary glTF header", where=path, expected=EXPECTED)
            _, total, length = struct.unpack("<III", head[4:16])
            if total > size or length > size - 20:
                raise InputError(
                    f"has {size:,} bytes but declares {max(total, length + 20):,}; is it truncated?",
                    where=path,
                )
            text = file.read(length)
        else:
            if size > LARGEST_JSON:
                raise InputError(f"{size:,} bytes of JSON", where=path, expected=f"{LARGEST_JSON:,} at most")
            text = file.read()
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"its JSON is damaged ({error})", where=path, expected=EXPECTED) from error
    if not isinstance(content, dict):
        raise InputError("its JSON is not an object", where=path, expected=EXPECTED)
    return content


def _check_counts(path: Path, content: dict[str, Any]) -> None:
    """Raise ``InputError`` for accessors with more numbers than their buffers hold."""
    views = content.get("bufferViews") or []
    for number, accessor in enumerate(content.get("accessors") or []):
        try:
            count = int(accessor["count"])
            size = count * BYTES[accessor["componentType"]] * NUMBERS[accessor["type"]]
            if "bufferView" in accessor:
                view = views[accessor["bufferView"]]
                held = int(view["byteLength"])
                buffer = int(content["buffers"][view["buffer"]]["byteLength"])
                held = min(held, buffer)
            else:
                held = max(path.stat().st_size, 2**20)  # zeros, which sparse values replace
            if count < 0 or size > held:
                raise InputError(
                    f"accessor {number} declares {count:,} elements, but {held:,} bytes are too few for"
                    " them; is it damaged?",
                    where=path,
                )
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise InputError(f"accessor {number} is not readable ({error!r})", where=path, expected=EXPECTED) from error


def _check_depth(path: Path, content: dict[str, Any]) -> None:
    """Raise ``InputError`` for long chains of nodes, which trimesh follows again for each node."""
    nodes = content.get("nodes") or []
    try:
        parents = {child: number for number, node in enumerate(nodes) for child in node.get("children") or ()}
        for start in range(len(nodes)):
            depth, at = 0, start
            while at in parents:
                depth, at = depth + 1, parents[at]
                if depth > DEEPEST:
                    found = f"has more than {DEEPEST} nodes below each other"
                    raise InputError(found, where=path, expected="fewer")
    except (TypeError, AttributeError) as error:
        raise InputError(f"its nodes are not readable ({error!r})", where=path, expected=EXPECTED) from error
