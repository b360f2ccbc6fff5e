"""PLY files: elements with named numeric properties, whose size is checked against the file before memory is allocated."""

from __future__ import annotations

import io
import itertools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import open_binary

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True)
class PlyElement:
    """One kind of element, as declared in a file's header."""

    name: str
    count: int
    properties: tuple[tuple[str, str], ...]  # name and NumPy type, without byte order
    has_lists: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the properties."""
        return tuple(name for name, _ in self.properties)


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file: the elements that it declares, and how their numbers are written."""

    order: str  # byte order, in NumPy's notation; "=" for a text file
    elements: tuple[PlyElement, ...]
    length: int  # bytes

    def element(self, name: str) -> PlyElement | None:
        """Return the declaration of the elements with that name, or None if there are none."""
        return next((element for element in self.elements if element.name == name), None)


def read_ply_header(path: Path, expected: str = "a PLY file") -> PlyHeader:
    """Read the header of a PLY file. Raises ``InputError`` if it is missing or malformed."""
    with open_binary(path, expected) as file:
        return _header(file, path, expected)


def read_ply(path: Path, expected: str = "a PLY file") -> dict[str, np.ndarray]:
    """Read the elements of a PLY file by name, each as a structured array with one field per property.

    Elements with lists, such as the faces of a mesh, and all elements after the first of these are left out.
    Raises ``InputError`` for a malformed header, and for more elements than a file of its size can hold.
    """
    with open_binary(path, expected) as file:
        header = _header(file, path, expected)
        check_ply_size(path, header)
        found: dict[str, np.ndarray] = {}
        for element in itertools.takewhile(lambda element: not element.has_lists, header.elements):
            kind = np.dtype([(name, header.order + of) for name, of in element.properties])
            if header.order == "=":
                found[element.name] = _text_rows(file, element.count, kind, path)
            elif kind.itemsize:
                found[element.name] = np.frombuffer(file.read(element.count * kind.itemsize), dtype=kind)
        return found


def check_ply_size(path: Path, header: PlyHeader) -> None:
    """Raise ``InputError`` if a file is too small for the elements that its header declares."""
    left = path.stat().st_size - header.length
    for element in header.elements:
        binary = sum(np.dtype(of).itemsize for _, of in element.properties)
        # A number in a text takes at least a digit and a separator.
        size = 2 * len(element.properties) if header.order == "=" else binary
        if element.count * (size + element.has_lists) > left + 1:  # the last line of a text may lack its end
            raise InputError(
                f"declares {element.count:,} elements {element.name!r}, but its {left:,} bytes of data"
                " are too few for them; is the file truncated?",
                where=path,
            )
        left -= element.count * (size + element.has_lists)


def _header(file: BinaryIO, path: Path, expected: str) -> PlyHeader:
    start = file.read(64 * 1024)
    end = start.find(b"end_header")
    stop = start.find(b"\n", end)
    if not start.startswith(b"ply") or end < 0 or stop < 0:
        raise InputError("no PLY header", where=path, expected=expected)
    order, elements = "", list[PlyElement]()
    for line in start[:end].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        try:
            if words[0] == "format":
                order = ORDERS[words[1]]
            elif words[0] == "element":
                elements.append(PlyElement(words[1], int(words[2]), ()))
                if elements[-1].count < 0:
                    raise ValueError
            elif words[0] == "property":
                last = elements[-1]
                if words[1] == "list":
                    elements[-1] = replace(last, has_lists=True)
                elif words[2] in last.names:
                    raise ValueError
                else:
                    elements[-1] = replace(last, properties=(*last.properties, (words[2], TYPES[words[1]])))
            else:
                raise ValueError
        except (ValueError, KeyError, IndexError) as error:
            raise InputError(
                f"its header has the line {line[:60]!r}", where=path, expected=expected
            ) from error
    if not order:
        raise InputError("its header names no format", where=path, expected=expected)
    # Any number of elements without properties would fit into no bytes.
    empty = [x.name for x in elements if x.count and not x.properties and not x.has_lists]
    if empty:
        raise InputError(f"the elements {empty[0]!r} have no properties", where=path, expected=expected)
    file.seek(stop + 1)
    return PlyHeader(order, tuple(elements), stop + 1)


def _text_rows(file: BinaryIO, count: int, kind: np.dtype, path: Path) -> np.ndarray:
    """Read the next ``count`` rows of numbers from a text file."""
    width = len(kind.names or ())
    lines = [file.readline() for _ in range(count)]
    try:
        rows = (
            np.loadtxt(io.BytesIO(b"".join(lines)), dtype=np.float64, ndmin=2)
            if lines
            else np.zeros((0, width))
        )
        if rows.shape != (count, width):
            raise ValueError(f"{rows.shape[0]} rows of {rows.shape[1]}")
    except ValueError as error:
        raise InputError(where=path, expected=f"{count:,} rows of {width} numbers ({error})") from error
    found = np.empty(count, kind)
    for number, name in enumerate(kind.names or ()):
        found[name] = rows[:, number]
    return found
