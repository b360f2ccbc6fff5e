"""PCD, the Point Cloud Library's format: text, binary, and LZF-compressed binary."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bidnerf_core.errors import InputError
from bidnerf_core.io import read_file
from bidnerf_scan.scan import Scan, colours_of

EXPECTED = "a PCD file"
LARGEST_HEADER = 64 * 1024


@dataclass(frozen=True)
class _Header:
    kind: np.dtype  # of a point
    count: int
    encoding: str
    length: int  # bytes


def recognises(path: Path) -> bool:
    """Return whether the file has the extension of a PCD file."""
    return path.suffix.lower() == ".pcd"


def read(path: Path) -> Scan:
    """Read the points of a PCD file. The pose of its sensor (VIEWPOINT) is ignored, since points are in the world."""
    data = read_file(path, EXPECTED, 4 * 2**30)  # bytes at most
    header = _header(path, data)
    rows = _rows(path, header, memoryview(data)[header.length :])
    names = header.kind.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"its points have {', '.join(names)}", where=path, expected="x, y and z")
    points = np.stack([rows[axis].astype(np.float64).reshape(len(rows), -1)[:, 0] for axis in "xyz"], axis=-1)
    return Scan(points, _colours(rows))


def _colours(rows: NDArray) -> NDArray[np.float32] | None:
    names = rows.dtype.names or ()
    packed = next((name for name in ("rgb", "rgba") if name in names), None)
    if packed is not None and rows.dtype[packed].itemsize == 4:
        # Three bytes in the bits of a number, which may be declared as a float.
        bits = np.ascontiguousarray(rows[packed]).view(np.uint32)
        return np.stack([(bits >> shift) & 255 for shift in (16, 8, 0)], axis=-1).astype(np.float32) / np.float32(255)
    return colours_of(rows, ("r", "g", "b"), ("red", "green", "blue"))


def _header(path: Path, data: bytes) -> _Header:
    found: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in found:
        end = data.find(b"\n", at, LARGEST_HEADER)
        if end < 0:
            raise InputError("no PCD header", where=path, expected=EXPECTED)
        words = data[at:end].decode("latin-1").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            found[words[0].upper()] = words[1:]
    try:
        names, sizes, types = found["FIELDS"], found["SIZE"], found["TYPE"]
        repeats = found.get("COUNT", ["1"] * len(names))
        fields = []
        for number, (name, size, of, repeat) in enumerate(zip(names, sizes, types, repeats, strict=True)):
            number_kind = f"<{ {'F': 'f', 'I': 'i', 'U': 'u'}[of.upper()] }{int(size)}"
            unique = f"_{number}" if name == "_" or name in names[:number] else name
            if not 0 < int(repeat) < 65536:
                raise ValueError(f"COUNT {repeat}")
            fields.append((unique, number_kind) if int(repeat) == 1 else (unique, number_kind, (int(repeat),)))
        count = int(found["POINTS"][0]) if "POINTS" in found else int(found["WIDTH"][0]) * int(found["HEIGHT"][0])
        kind = np.dtype(fields)
        if count < 0:
            raise ValueError(f"{count} points")
        return _Header(kind, count, found["DATA"][0].lower(), at)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise InputError(f"its header is damaged ({error!r})", where=path, expected=EXPECTED) from error


def _rows(path: Path, header: _Header, data: memoryview) -> NDArray:
    """Return the points as a structured array. Counts are checked against the data before memory is allocated."""
    size = header.count * header.kind.itemsize
    if header.encoding == "ascii":
        # A number takes at least two bytes of text, including the separator.
        _require(path, header, _width(header) * 2 * header.count, len(data) + 1)
        return _text_rows(path, header, bytes(data))
    if header.encoding == "binary":
        _require(path, header, size, len(data))
        return np.frombuffer(data[:size], header.kind)
    if header.encoding != "binary_compressed":
        raise InputError(f"DATA {header.encoding}", where=path, expected="ascii, binary or binary_compressed")
    if len(data) < 8:
        _require(path, header, size, 0)
    packed, whole = (int(n) for n in np.frombuffer(data[:8], "<u4"))
    _require(path, header, packed, len(data) - 8)
    # One byte of LZF represents at most 300 bytes.
    _require(path, header, size, min(whole, 300 * packed))
    columns = _decompressed(path, bytes(data[8 : 8 + packed]), whole)
    rows, at = np.zeros(header.count, header.kind), 0
    for name in header.kind.names or ():  # field by field, each for all points
        kind = header.kind[name]
        width = header.count * kind.itemsize
        rows[name] = np.frombuffer(columns[at : at + width], kind.base).reshape(rows[name].shape)
        at += width
    return rows


def _width(header: _Header) -> int:
    return sum(int(np.prod(header.kind[name].shape)) for name in header.kind.names or ())


def _require(path: Path, header: _Header, needed: int, held: int) -> None:
    if needed > held:
        raise InputError(
            f"declares {header.count:,} points, for which its {held:,} bytes of data are too few; is the"
            " file truncated?",
            where=path,
        )


def _text_rows(path: Path, header: _Header, text: bytes) -> NDArray:
    try:
        table = np.loadtxt(io.BytesIO(text), dtype=np.float64, ndmin=2, max_rows=header.count)
        if header.count == 0:
            table = np.zeros((0, _width(header)))
        if table.shape != (header.count, _width(header)):
            raise ValueError(f"found {table.shape[0]:,} rows of {table.shape[1]}")
    except ValueError as error:
        raise InputError(
            where=path,
            expected=f"{header.count:,} rows of {_width(header)} numbers ({error}); is the file truncated?",
        ) from error
    rows, at = np.zeros(header.count, header.kind), 0
    for name in header.kind.names or ():
        kind = header.kind[name]
        width = int(np.prod(kind.shape))
        with np.errstate(invalid="ignore", over="ignore"):
            rows[name] = table[:, at : at + width].astype(kind.base).reshape(rows[name].shape)
        at += width
    return rows


def _decompressed(path: Path, data: bytes, size: int) -> bytes:
    """Decompress LZF (Lehmann 2000): literal runs, and copies of earlier output."""
    found, at = bytearray(), 0
    try:
        while at < len(data):
            control = data[at]
            at += 1
            if control < 32:
                found += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(found) - ((control & 31) << 8) - data[at] - 1
            at += 1
            if start < 0:
                raise IndexError
            length += 2
            pattern = found[start : start + length]
            while len(pattern) < length:  # a copy may overlap itself
                pattern += pattern[: length - len(pattern)]
            found += pattern
            if len(found) > size:
                raise IndexError
    except IndexError as error:
        raise InputError("its compressed data is damaged; is the file truncated?", where=path) from error
    if len(found) != size:
        raise InputError(f"{len(found):,} bytes when decompressed", where=path, expected=f"{size:,}; is it truncated?")
    return bytes(found)
