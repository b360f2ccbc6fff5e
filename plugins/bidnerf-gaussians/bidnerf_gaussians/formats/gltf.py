"""glTF 2.0 with the extension ``KHR_gaussian_splatting`` (Khronos, review draft): ``.glb``, or ``.gltf`` with
accompanying files.
"""

from __future__ import annotations

import functools
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from bidnerf_core.errors import InputError
from bidnerf_core.io import Allowance, parse_json, read_file
from bidnerf_gaussians.formats.parts import LARGEST_FILE, gaussians_of, joined, logit, take_gaussians
from bidnerf_gaussians.gaussians import COEFFICIENTS, Gaussians

EXTENSION = "KHR_gaussian_splatting"
EXPECTED = f"a glTF file with {EXTENSION}"
MAGIC = b"glTF"
JSON, BINARY = 0x4E4F534A, 0x004E4942
"""The kinds of chunks of a .glb file."""
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def recognises(path: Path) -> bool:
    """Return whether the file is a glTF that names the extension near its beginning."""
    if path.suffix.lower() not in (".glb", ".gltf") or not path.is_file():
        return False
    with path.open("rb") as file:
        # Only the first megabyte is searched for the name of the extension.
        return EXTENSION.encode() in file.read(1 << 20)


@dataclass(frozen=True, eq=False)
class _Scene:
    """The content of a file."""

    path: Path
    gltf: dict[str, Any]
    binary: bytes | None  # of a .glb

    @functools.lru_cache(maxsize=1)  # accessor by accessor, files beside would be read again  # noqa: B019
    def buffer(self, number: int) -> bytes:
        entry = self.gltf["buffers"][number]
        uri = entry.get("uri")
        if uri is None and self.binary is not None and number == 0:
            return self.binary
        if not isinstance(uri, str) or Path(uri).name != uri:
            raise InputError(f"names a buffer {str(uri)[:40]!r}", where=self.path, expected="a file next to it")
        return read_file(self.path.parent / uri, f"a buffer of {EXPECTED}", LARGEST_FILE)

    def accessor(self, number: int) -> np.ndarray:
        """Return the numbers (n w) of an accessor; normalized integers become fractions."""
        entry = self.gltf["accessors"][number]
        if "sparse" in entry or "bufferView" not in entry:
            raise InputError(f"accessor {number} is sparse or empty", where=self.path, expected="plain numbers")
        view = self.gltf["bufferViews"][entry["bufferView"]]
        kind, width, count = (
            np.dtype(COMPONENTS[entry["componentType"]]),
            WIDTHS[entry["type"]],
            entry["count"],
        )
        start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
        stride = view.get("byteStride", width * kind.itemsize)
        content = self.buffer(view["buffer"])
        last = start + (count - 1) * stride + width * kind.itemsize
        if min(start, count, stride - width * kind.itemsize) < 0 or last > len(content):
            raise InputError(
                f"accessor {number} declares {count:,} elements, but its buffer of {len(content):,} bytes is too short",
                where=self.path,
            )
        rows = np.ndarray((count, width), kind, content, start, (stride, kind.itemsize)).astype(np.float32)
        if not entry.get("normalized"):
            return rows
        return np.maximum(rows / np.float32(np.iinfo(kind).max), -1)


def read(path: Path) -> Gaussians:
    """Read the Gaussians of all nodes of a file, each with its node's transform applied.

    Raises ``InputError`` for a damaged file.
    """
    scene = _opened(path)
    try:
        shown, allowance = _shown_meshes(scene), Allowance.of(path, EXPECTED)
        meshes = {
            number: [
                _gaussians(scene, primitive, allowance)
                for primitive in scene.gltf["meshes"][number]["primitives"]
                if EXTENSION in primitive.get("extensions", {})
            ]
            for number in dict.fromkeys(number for number, _ in shown)
        }
        # Nodes could show a mesh any number of times, and meshes the same numbers.
        for part in (part for number, _ in shown for part in meshes[number]):
            take_gaussians(allowance, len(part), part.harmonics.shape[1])
        found = [_placed(part, matrix, path) for number, matrix in shown for part in meshes[number]]
    except (KeyError, TypeError, IndexError, ValueError, AttributeError, RuntimeError) as error:
        if isinstance(error, InputError) and error.where:
            raise
        raise InputError(f"is damaged ({type(error).__name__}: {error})", where=path, expected=EXPECTED) from error
    if not found:
        raise InputError("no node shows Gaussians", where=path, expected=EXPECTED)
    return joined(found)


def _opened(path: Path) -> _Scene:
    content = read_file(path, EXPECTED, LARGEST_FILE)
    text, binary = content, None
    if content.startswith(MAGIC):
        chunks = dict[int, bytes]()
        place = 12
        while place + 8 <= len(content):
            length, kind = struct.unpack_from("<II", content, place)
            if place + 8 + length > len(content):
                raise InputError(f"a chunk of {length:,} bytes is truncated", where=path, expected=EXPECTED)
            chunks.setdefault(kind, content[place + 8 : place + 8 + length])
            place += 8 + length
        if JSON not in chunks:
            raise InputError("has no JSON chunk", where=path, expected=EXPECTED)
        text, binary = chunks[JSON], chunks.get(BINARY)
    gltf = parse_json(text, str(path), EXPECTED)
    if not isinstance(gltf, dict):
        raise InputError("its JSON is not an object", where=path, expected=EXPECTED)
    return _Scene(path, gltf, binary)


def _shown_meshes(scene: _Scene) -> list[tuple[int, np.ndarray]]:
    """Return the numbers of the meshes that nodes show, with the nodes' transforms to the world."""
    nodes = scene.gltf.get("nodes", [])
    parents = {child: number for number, node in enumerate(nodes) for child in node.get("children", [])}
    worlds: dict[int | None, np.ndarray] = {None: np.eye(4)}
    for start in range(len(nodes)):
        chain, at = dict[int, None](), start
        while at not in worlds:
            if at in chain:
                raise InputError("its nodes are children of themselves", where=scene.path)
            chain[at] = None
            at = parents.get(at)
        for number in reversed(chain):
            worlds[number] = worlds[parents.get(number)] @ _local(nodes[number])
    return [(node["mesh"], worlds[number]) for number, node in enumerate(nodes) if "mesh" in node]


def _local(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T  # column by column
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(node.get("rotation", (0, 0, 0, 1))).as_matrix() * node.get("scale", (1, 1, 1))
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _gaussians(scene: _Scene, primitive: dict[str, Any], allowance: Allowance) -> Gaussians:
    names = primitive["attributes"]
    if "extensions" in primitive["extensions"][EXTENSION]:
        further = ", ".join(primitive["extensions"][EXTENSION]["extensions"])
        raise InputError(f"its Gaussians are compressed ({further}), which is not supported", where=scene.path)
    harmonics = []
    for degree in COEFFICIENTS:
        of_degree = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)]
        if degree and of_degree[0] not in names:
            break
        harmonics += [scene.accessor(names[name]) for name in of_degree]
    position, scale, rotation, opacity = (
        scene.accessor(names[name])
        for name in (
            "POSITION",
            f"{EXTENSION}:SCALE",
            f"{EXTENSION}:ROTATION",
            f"{EXTENSION}:OPACITY",
        )
    )
    shapes = [part.shape for part in (position, scale, rotation, opacity, *harmonics)]
    count = len(position)
    take_gaussians(allowance, count, len(harmonics))
    if shapes != [(count, 3), (count, 3), (count, 4), (count, 1), *[(count, 3)] * len(harmonics)]:
        raise InputError(f"its attributes have the shapes {shapes}", where=scene.path, expected="one for each Gaussian")
    return gaussians_of(
        position, scale, np.roll(rotation, 1, axis=-1), logit(opacity[:, 0]), np.stack(harmonics, axis=1)
    )


def _placed(gaussians: Gaussians, matrix: np.ndarray, path: Path) -> Gaussians:
    """Return the Gaussians with a node's transform applied. Raises ``InputError`` if it stretches or mirrors them."""
    scales = np.linalg.norm(matrix[:3, :3], axis=0)
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    # Scales along a node's axes count as equal up to a relative difference of a thousandth.
    if not scale > 0 or float(np.ptp(scales)) > 1e-3 * scale:
        raise InputError("a node stretches or mirrors its Gaussians", where=path, expected="one scale for all axes")
    rotation = torch.from_numpy(matrix[:3, :3] / scale)
    return gaussians.similar(scale, rotation, torch.from_numpy(matrix[:3, 3].copy()))
