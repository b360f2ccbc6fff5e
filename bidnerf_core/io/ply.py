"""PLY files: elements with named numeric properties, whose size is checked against the file before memory is allocated."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bidnerf_core.errors import InputError
from bidnerf_core.io.files import library_errors, open_binary

TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}


@dataclass(frozen=True)
class PlyElement:
    """One kind of element, as declared in a file's header."""

    count: int
    properties: dict[str, str]  # NumPy types with their byte order, by name
    lists: list[str]  # the names of properties that are lists


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file: the elements that it declares, and the format of their numbers."""

    is_text: bool
    elements: dict[str, PlyElement]
    length: int  # bytes


def read_ply_header(path: Path, expected: str = "a PLY file") -> PlyHeader:
    """Read the header of a PLY file. Raises ``InputError`` if the header is missing or malformed."""
    with open_binary(path, expected) as file:
        start = file.read(64 * 1024)
    end = start.find(b"end_header")
    stop = start.find(b"\n", end)
    if not start.startswith(b"ply") or end < 0 or stop < 0:
        raise InputError("no PLY header", where=path, expected=expected)
    order, elements, last = "", dict[str, PlyElement](), ""
    for line in start[:end].decode("latin-1").splitlines()[1:]:
        try:
            match line.split():
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", form, *_]:
                    order = ORDERS[form]
                case ["element", last, count] if int(count) >= 0:
                    elements[last] = PlyElement(int(count), {}, [])
                case ["property", "list", _, _, name]:
                    elements[last].lists.append(name)
                case ["property", kind, name] if name not in elements[last].properties:
                    elements[last].properties[name] = order + TYPES[kind]
                case _:
                    raise ValueError
        except (ValueError, KeyError) as error:
            raise InputError(f"its header has the line {line[:60]!r}", where=path, expected=expected) from error
    if not order:
        raise InputError("its header names no format", where=path, expected=expected)
    for (
        name,
        element,
    ) in elements.items():  # elements without properties take no bytes, so any number would fit
        if element.count and not element.properties and not element.lists:
            raise InputError(f"the elements {name!r} have no properties", where=path, expected=expected)
    return PlyHeader(order == "=", elements, stop + 1)


def read_ply(path: Path, expected: str = "a PLY file") -> dict[str, np.ndarray]:
    """Read the elements of a PLY file by name, each as a structured array with one field per property.

    Elements with lists, such as the faces of a mesh, and all elements after the first of these are left out.
    Raises ``InputError`` for a malformed header, and for more elements than a file of its size can hold.
    """
    header = read_ply_header(path, expected)
    check_ply_size(path, header)
    found: dict[str, np.ndarray] = {}
    with open_binary(path, expected) as file:
        file.seek(header.length)
        for name, element in itertools.takewhile(lambda item: not item[1].lists, header.elements.items()):
            kind = np.dtype(list(element.properties.items()))
            rows_expected = f"{element.count:,} rows of {len(element.properties)} numbers"
            with library_errors(path, "is damaged", rows_expected, ValueError, TypeError, OverflowError):
                if header.is_text:
                    rows = [file.readline().split() for _ in range(element.count)]
                    columns = np.array(rows, np.float64).reshape(element.count, len(element.properties)).T
                    found[name] = np.zeros(element.count, kind)
                    for column, (part, of) in zip(columns, element.properties.items(), strict=True):
                        with np.errstate(invalid="ignore", over="ignore"):
                            found[name][part] = column
                        # Some programs write 255.0 for a byte, but 256 and 0.5 are not bytes.
                        if np.dtype(of).kind in "iu" and (found[name][part] != column).any():
                            raise ValueError(f"{part} is not of its type")
                elif kind.itemsize:
                    found[name] = np.frombuffer(file.read(element.count * kind.itemsize), kind)
    return found


def check_ply_size(path: Path, header: PlyHeader) -> None:
    """Raise ``InputError`` if a file is too small for the elements that its header declares."""
    left = path.stat().st_size - header.length
    for name, element in header.elements.items():
        binary = sum(np.dtype(of).itemsize for of in element.properties.values())
        # A number in a text takes at least a digit and a separator, and a list at least a byte.
        size = (2 * len(element.properties) if header.is_text else binary) + bool(element.lists)
        if element.count * size > left + 1:  # the last line of a text may lack its end
            raise InputError(
                f"declares {element.count:,} elements {name!r}, but its {left:,} bytes of data"
                " are too few for them; is the file truncated?",
                where=path,
            )
        left -= element.count * size
