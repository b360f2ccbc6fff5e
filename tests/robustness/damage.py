"""Malformed files as strategies of hypothesis: JSON, images, arrays, points, tensors, COLMAP's binary files.

Each function takes sound content and returns, by the kinds of damage, strategies that draw damaged content.
"""

from __future__ import annotations

import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from hypothesis import strategies as st
from PIL import Image

from bombs import chunk, png

Damages: TypeAlias = dict[str, st.SearchStrategy[bytes]]

TERMINAL = "\x1b[2J\x1b]0;owned\x07\x9b31m\x00\r\u202e\ud800\u2028"
"""Text that clears a terminal, sets its title, and colours and reverses what follows; it has half of a surrogate pair."""
PLAIN_TERMINAL = TERMINAL.replace("\ud800", "").replace("\0", "")
"""The part of it that a file's name can hold."""
TEXTS = (
    "",
    " ",
    TERMINAL,
    "../../etc/passwd",
    "/dev/zero",
    "a" * 5000,
    "\0",
    "NaN",
    "1e400",
    "-1",
    "%s%n",
    "{0}",
)
NUMBERS = (
    "NaN",
    "Infinity",
    "-Infinity",
    "1e400",
    "-1e308",
    "1e-320",
    "0",
    "-1",
    "1.5",
    "9" * 30,
    "1" + "0" * 400,
    str(2**63),
)
OTHER_VALUES: tuple[Any, ...] = (None, True, [], {}, "text", 0, -1, 1.5, [[]], [None], {"": {}}, [1, 2, 3])
LARGE = 100_000
"""Columns and rows of images and arrays that are too large for any memory."""
NOISE = st.binary(min_size=1, max_size=7) | st.integers(0, 99).map(lambda seed: noise(seed, 4096))


def noise(seed: int, count: int) -> bytes:
    return np.random.default_rng(seed).bytes(count)


def draw_damage(damages: Damages) -> st.SearchStrategy[tuple[str, bytes]]:
    """Draw a kind of damage, and content that has it."""
    return st.sampled_from(sorted(damages)).flatmap(lambda name: st.tuples(st.just(name), damages[name]))


def of_bytes(content: bytes) -> Damages:
    place = st.integers(0, max(0, len(content) - 1))

    def flipped(changes: list[tuple[int, int]]) -> bytes:
        changed = bytearray(content or b"\0")
        for where, value in changes:
            changed[where] = value
        return bytes(changed)

    return {
        "cut": place.map(lambda end: content[:end]),
        "flipped": st.lists(st.tuples(place, st.integers(0, 255)), min_size=1, max_size=64).map(flipped),
        "noise": NOISE,
        "empty": st.just(b""),
        "appended": NOISE.map(lambda more: content + more),
    }


# JSON. A marker replaces a value, and is itself replaced in the text, since Python's JSON does not write 1e400.

MARKER = "@marker@"
ROOTS = (b"[]", b"null", b"{}", b"1", b'"x"', b"\xff\xfe{\0}\0", b"\xef\xbb\xbf{}", b"{,}", b"'a'")


def places_of(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all values inside ``value``."""
    inside = enumerate(value) if isinstance(value, list) else value.items() if isinstance(value, dict) else ()
    return [place for key, item in inside for place in ((*path, key), *places_of(item, (*path, key)))]


def at(value: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        value = value[key]
    return value


def replaced_at(content: bytes, place: tuple[Any, ...], text: str) -> bytes:
    """Put JSON ``text`` in the place of a value."""
    whole = [json.loads(content)]
    *outer, last = (0, *place)
    at(whole, tuple(outer))[last] = MARKER
    return json.dumps(whole)[1:-1].replace(json.dumps(MARKER), text).encode(errors="surrogatepass")


def of_json(content: bytes) -> Damages:
    whole = json.loads(content)
    places = places_of(whole)

    def put(text: st.SearchStrategy[str], kinds: Any = object) -> st.SearchStrategy[bytes]:
        """Put JSON in the place of any value of one of ``kinds``."""
        some = [place for place in places if isinstance(at(whole, place), kinds)] or [()]
        return st.builds(partial(replaced_at, content), st.sampled_from(some), text)

    def edited(kind: type, edit: Callable[[Any, Any, int], object]) -> st.SearchStrategy[bytes]:
        """Change an entry of any object or list, which ``edit`` gets with the key and a number."""
        some = [place for place in places if isinstance(at(whole, place[:-1]), kind)]

        def change(place: tuple[Any, ...], number: int) -> bytes:
            new = json.loads(content)
            edit(at(new, place[:-1]), place[-1], number)
            return json.dumps(new).encode()

        return st.builds(change, st.sampled_from(some), st.integers(0, 3)) if some else st.just(content)

    def renamed(record: dict[str, Any], key: str, number: int) -> None:
        record[(TERMINAL, key + "s", key.upper(), "")[number]] = record.pop(key)

    values = st.sampled_from(OTHER_VALUES)
    damages = of_bytes(content) | {
        "wrong type": put(values.map(json.dumps)),
        "odd number": put(st.sampled_from(NUMBERS), (int, float)) | put(st.sampled_from(NUMBERS)),
        "odd text": put(st.sampled_from(TEXTS).map(json.dumps), str),
        "deep nesting": put(
            st.builds(
                lambda depth, ends: ends[0] * depth + "1" + ends[1] * depth,
                st.sampled_from((50, 900, 5000, LARGE)),
                st.sampled_from(("[]", ('{"a":', "}"))),
            )
        ),
        "missing key": edited(dict, lambda record, key, number: record.pop(key)),
        "other key": edited(dict, renamed),
        "longer list": edited(list, lambda found, key, number: found.append(found[0])),
        "shorter list": edited(list, lambda found, key, number: found.pop(key)),
        "another root": st.sampled_from(ROOTS),
    }
    if isinstance(whole, dict) and whole:
        damages["key twice"] = st.builds(
            lambda key, value: f"{json.dumps(whole)[:-1]}, {json.dumps(key)}: {json.dumps(value)}}}".encode(),
            st.sampled_from(sorted(whole)),
            values,
        )
    return damages


# Images.

SIZES = (
    (LARGE, LARGE),
    (2**31 - 1, 1),
    (1, 2**31 - 1),
    (0, 5),
    (2000, 1500),
    (25, 24),
)
MODES = (
    ("L", "PNG"),
    ("LA", "PNG"),
    ("P", "PNG"),
    ("P", "GIF"),
    ("1", "PNG"),
    ("CMYK", "JPEG"),
    ("F", "TIFF"),
    ("I", "TIFF"),
    ("I;16", "PNG"),
    ("YCbCr", "JPEG"),
    ("LAB", "TIFF"),
    ("RGB", "BMP"),
    ("RGB", "WEBP"),
    ("L", "PPM"),
)
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 24\n%%EndComments\n{} loop\n"


def encode(image: Image.Image, kind: str, **more: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **more)
    return file.getvalue()


def zeros_png(side: int, colour: int = 0, channels: int = 1) -> bytes:
    """Return a PNG of ``side`` squared black pixels, a thousandth of their size."""
    return png(side, side, 8, colour, b"\0" * (side * (side * channels + 1)))


def of_image(content: bytes) -> Damages:
    image = Image.open(io.BytesIO(content)).convert("RGB")
    frames = [Image.new("RGB", (24, 24), (i, 0, 0)) for i in range(3)]
    of_jpeg = of_bytes(encode(image, "JPEG"))

    def size_in_header(size: tuple[int, int]) -> bytes:
        """Return a PNG with another size in its header, and a correct checksum."""
        return content[:8] + chunk(b"IHDR", struct.pack(">II", *size) + content[24:29]) + content[33:]

    def sixteen_bits(colour: int, channels: int) -> bytes:
        rows = b"".join(b"\0" + noise(row, 48 * channels) for row in range(24))
        return png(24, 24, 16, colour, rows)

    return of_bytes(content) | {
        "size in the header": st.sampled_from(SIZES).map(size_in_header),
        "another mode": st.sampled_from(MODES).map(
            lambda mode: encode((image.convert("I") if mode[0] == "I;16" else image).convert(mode[0]), mode[1])
        ),
        "16 bits per channel": st.sampled_from(((2, 3), (4, 2), (6, 4))).map(lambda kind: sixteen_bits(*kind)),
        "animated": st.sampled_from(("GIF", "PNG", "WEBP", "TIFF")).map(
            lambda kind: encode(frames[0], kind, save_all=True, append_images=frames[1:])
        ),
        "one pixel or line": st.builds(
            lambda size, kind: encode(Image.new("RGB", size), kind),
            st.sampled_from(((1, 1), (1, 24), (24, 1))),
            st.sampled_from(("PNG", "JPEG")),
        ),
        "compressed zeros": st.sampled_from((500, 2000)).map(zeros_png),
        "part of a JPEG": of_jpeg["cut"] | of_jpeg["flipped"],
        "EXIF of noise": st.sampled_from((2, 40, 400)).map(
            lambda count: encode(image, "JPEG", exif=b"Exif\0\0II*\0\x08\0\0\0" + noise(count, count))
        ),
        # A thousand times as long as the file.
        "long compressed text": st.builds(
            lambda: content[:33] + chunk(b"zTXt", b"k\0\0" + zlib.compress(b"a" * 5_000_000)) + content[33:]
        ),
        "PostScript": st.just(POSTSCRIPT),
    }


# Arrays of numpy, as depth and as points.

SHAPES = ((24, 24), (24, 25), (24, 24, 3), (0, 24), (), (24,), (576, 3), (0, 3), (1, 3))
KINDS = ("f2", "f4", "f8", "i1", "u2", "i4", "u8", "c16", "U3", "S2", "?", "M8[s]", "f4,i4", ">f4")
VALUES = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e10, 3.4e38, 1e308, 1e-320, 65.535)
HEADER_SHAPES = (
    "(100000, 100000)",
    "(1000000000000,)",
    "(-1, 24)",
    "(24, 24)" * 3,
    "(" * 500,
    f"({'9' * 50}, 3)",
    "(1, 2",
)
ROWS = (
    b"1 2\n3 4\n",
    b"1,5 2,5\n",
    b"nan inf 1\n",
    b"a b c\n",
    b"1 2 3\n4 5\n",
    b"# \x1b[2J\n",
    b"1e400 0 1\n",
    b"0 0 0\n",
    b"1 2 3 " * 20_000,
    b"1_0 2 3\n",
    b"\xff\xfe1 2 3\n",
    b"1;2;3\n",
    b"-1 -2 -3\n",
    b"\0\0\0",
)


def array_bytes(array: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def array_file(kind: str, shape: str, content: bytes = b"\0" * 100) -> bytes:
    """Return an array file with any header."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header + content


def archive_of(name: str, content: bytes, sensor: bytes | None, bomb: bool) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as parts:
        parts.writestr(name, content)
        if sensor is not None:
            parts.writestr("T_camera_sensor.npy", sensor)
        if bomb:
            large = array_file("<f8", "(100000000, 3)", b"\0" * 40_000_000)
            parts.writestr("points.npy" if name != "points.npy" else "more.npy", large)
    return file.getvalue()


def of_array(content: bytes) -> Damages:
    def array(shape: tuple[int, ...], kind: str) -> bytes:
        return array_bytes(np.zeros(shape, kind) if kind == "f4,i4" else np.ones(shape).astype(kind))

    arrays = st.builds(array, st.sampled_from(SHAPES), st.sampled_from(KINDS))
    damages: Damages = {
        "another array": arrays,
        "odd values": st.sampled_from(VALUES).map(lambda value: array_bytes(np.full((24, 24), value)))
        | st.sampled_from(VALUES).map(lambda value: array_bytes(np.full((192, 3), value))),
        "pickled": st.just(array_bytes(np.array([{"a": 1}, None], dtype=object))),
        "header of an array": st.builds(
            array_file,
            st.sampled_from(("<f8", "<f4", "O", "V1000000000", "x", "\\x1b[31m")),
            st.sampled_from(HEADER_SHAPES),
        ),
    }
    names = ("points.npy", "points", "other.npy", "T_camera_sensor.npy", PLAIN_TERMINAL)
    inside = st.one_of(NOISE, *damages.values())
    archive = st.builds(
        archive_of, st.sampled_from(names), inside, st.none() | arrays, st.sampled_from([False] * 4 + [True])
    )
    return of_bytes(content) | damages | {"archive": archive}


def of_points(content: bytes) -> Damages:
    return of_bytes(content) | {"odd points": st.sampled_from(ROWS)}


# Tensors, in the format of safetensors: the length of a header, a header of JSON, numbers.

TYPES = ("F8_E4M3", "F64", "BF16", "I32", "U8", "BOOL", "F4", "C64", "X", "\x1b[2J")


def parts_of(content: bytes) -> tuple[dict[str, Any], bytes]:
    length = struct.unpack("<Q", content[:8])[0]
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def join(header: bytes | dict[str, Any], numbers: bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + numbers


def of_tensors(content: bytes) -> Damages:
    header, numbers = parts_of(content)
    names = st.sampled_from([name for name in header if name != "__metadata__"])
    headers = of_json(json.dumps(header).encode())
    del headers["deep nesting"], headers["empty"]

    def with_entry(name: str, changes: dict[str, Any]) -> bytes:
        return join(header | {name: header[name] | changes}, numbers)

    def another_shape(name: str, number: int) -> bytes:
        shape = header[name]["shape"]
        shapes = ([*shape, 1], [1, *shape], shape[::-1], [], [-1], [2**62, 4], [0], [int(np.prod(shape))])
        return with_entry(name, {"shape": shapes[number]})

    def another_name(name: str, other: str) -> bytes:
        return join({other if key == name else key: entry for key, entry in header.items()}, numbers)

    def filled(name: str, byte: bytes) -> bytes:
        """Fill a tensor with one byte: NaN, whatever its type, of 0xff; large and negative numbers of others."""
        begin, end = header[name]["data_offsets"]
        return join(header, numbers[:begin] + byte * (end - begin) + numbers[end:])

    def random_numbers(begin: int, count: int) -> bytes:
        new = noise(begin, min(count, len(numbers) - begin))
        return join(header, numbers[:begin] + new + numbers[begin + len(new) :])

    damages = of_bytes(content) | {
        "length of the header": st.sampled_from((0, 1, 2**63, 2**64 - 1, 10**8, len(content))).map(
            lambda length: struct.pack("<Q", length) + content[8:]
        ),
        "header of tensors": st.one_of(*headers.values()).map(lambda changed: join(changed, numbers)),
        "another type": st.builds(with_entry, names, st.sampled_from([{"dtype": kind} for kind in TYPES])),
        "another shape": st.builds(another_shape, names, st.integers(0, 7)),
        "not finite": st.builds(filled, names, st.just(b"\xff")),
        "of one byte": st.builds(filled, names, st.sampled_from((b"\0", b"\x7e", b"\xfe"))),
        "another name": st.builds(another_name, names, st.sampled_from((TERMINAL.replace("\ud800", ""), "other", ""))),
        "random numbers": st.builds(random_numbers, st.integers(0, len(numbers) - 1), st.sampled_from((1, 4, 1000))),
    }
    if text := header.get("__metadata__", {}).get("bidnerf"):  # plain data beside the tensors
        damages["metadata"] = st.one_of(*of_json(text.encode()).values()).map(
            lambda changed: join(
                header | {"__metadata__": {"bidnerf": changed.decode(errors="surrogateescape")}}, numbers
            )
        )
    return damages


# COLMAP's binary files, which begin with a count of 64 bits.


COUNTS = (2**63, -1, 2**31, 10**6, 0)
"""Counts of more than a file holds, of fewer, negative, and of more than any memory."""
PLACES = (0, 16, 8 + struct.calcsize("<I7dI") + len("1.png\0"), 8 + struct.calcsize("<q3d3Bd"))
"""Where a model has its count of cameras, images or points, the width of the first camera, the number of keypoints of the first
image, and the length of the track of the first point.
"""


def of_colmap(content: bytes) -> Damages:
    known = struct.unpack_from("<Q", content)[0]

    def with_count(count: int, place: int) -> bytes:
        return content[:place] + struct.pack("<Q", count % 2**64) + content[place + 8 :]

    return of_bytes(content) | {
        **{f"count {number}": st.just(with_count(number, 0)) for number in (*COUNTS, known + 1, known - 1)},
        "count inside": st.builds(
            with_count, st.sampled_from(COUNTS), st.sampled_from(PLACES) | st.integers(0, len(content) - 8)
        ),
        "name without an end": st.just(content.replace(b"\0", b"x")),
    }
