"""Malformed files, drawn at random: JSON, images, arrays, points, tensors, COLMAP's binary files.

Each table maps the name of a kind of damage to a function of a ``random.Random`` and of the sound content, which returns the
damaged content.
"""

from __future__ import annotations

import copy
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any, TypeAlias

import numpy as np
from PIL import Image

Damage: TypeAlias = Callable[[Random, bytes], bytes]

TERMINAL = "\x1b[2J\x1b]0;owned\x07\x9b31m\x00\r\u202e\ud800\u2028"
"""Text that clears a terminal, sets its title, and colours and reverses what follows; it has half of a surrogate pair."""
PLAIN_TERMINAL = TERMINAL.replace("\ud800", "").replace("\0", "")
"""The part of it that a file's name can hold."""
TEXTS = (
    "", " ", TERMINAL, "../../etc/passwd", "/dev/zero", "a" * 5000, "\0", "NaN", "1e400", "-1", "%s%n", "{0}",
)  # fmt: skip
NUMBERS = (
    "NaN", "Infinity", "-Infinity", "1e400", "-1e308", "1e-320", "0", "-1", "1.5", "9" * 30, "1" + "0" * 400, str(2**63),
)  # fmt: skip
OTHER_VALUES: tuple[Any, ...] = (None, True, [], {}, "text", 0, -1, 1.5, [[]], [None], {"": {}}, [1, 2, 3])
LARGE = 100_000
"""Columns and rows of images and arrays that are too large for any memory."""


def cut(chance: Random, content: bytes) -> bytes:
    return content[: chance.randrange(max(1, len(content)))]


def flipped(chance: Random, content: bytes) -> bytes:
    changed = bytearray(content or b"\0")
    for _ in range(chance.choice((1, 1, 2, 8, 64))):
        changed[chance.randrange(len(changed))] = chance.randrange(256)
    return bytes(changed)


def noise(chance: Random, content: bytes) -> bytes:
    return chance.randbytes(chance.choice((1, 7, 100, 4096)))


BYTES: dict[str, Damage] = {
    "cut": cut,
    "flipped": flipped,
    "noise": noise,
    "empty": lambda chance, content: b"",
    "appended": lambda chance, content: content + noise(chance, content),
}


# JSON. A marker replaces a value, and is itself replaced in the text, since Python's JSON does not write 1e400.

MARKER = "@marker@"


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
    whole = json.loads(content)
    *outer, last = place
    at(whole, tuple(outer))[last] = MARKER
    return json.dumps(whole).replace(json.dumps(MARKER), text).encode(errors="surrogatepass")


def replaced(chance: Random, content: bytes, text: str, kinds: type | tuple[type, ...] = object) -> bytes:
    """Put JSON ``text`` in the place of a random value of one of ``kinds``."""
    whole = json.loads(content)
    places = [place for place in places_of(whole) if isinstance(at(whole, place), kinds)]
    return (
        replaced_at(content, chance.choice(places), text) if places else text.encode(errors="surrogatepass")
    )


def deep(chance: Random, content: bytes) -> bytes:
    depth = chance.choice((50, 900, 5000, LARGE))
    opening, closing = chance.choice((("[", "]"), ('{"a":', "}")))
    return replaced(chance, content, opening * depth + "1" + closing * depth)


def with_key(change: Callable[[Random, dict[str, Any], str], None]) -> Damage:
    """Return a damage that changes the entry of one key of one object."""

    def damage(chance: Random, content: bytes) -> bytes:
        whole = json.loads(content)
        places = [place for place in places_of(whole) if isinstance(place[-1], str)]
        if places:
            *outer, last = chance.choice(places)
            change(chance, at(whole, tuple(outer)), last)
        return json.dumps(whole).encode()

    return damage


def renamed(chance: Random, record: dict[str, Any], key: str) -> None:
    """Rename a key, to a name with control characters or a typing error."""
    record[chance.choice((TERMINAL, key + "s", key.upper(), ""))] = record.pop(key)


def twice(chance: Random, content: bytes) -> bytes:
    """Give a key two values."""
    whole = json.loads(content)
    if not isinstance(whole, dict) or not whole:
        return content
    key, more = chance.choice(list(whole)), json.dumps(chance.choice(OTHER_VALUES))
    return f"{json.dumps(whole)[:-1]}, {json.dumps(key)}: {more}}}".encode()


def short_list(chance: Random, content: bytes) -> bytes:
    whole = json.loads(content)
    lists = [place for place in places_of(whole) if isinstance(at(whole, place), list) and at(whole, place)]
    if lists:
        found = at(whole, chance.choice(lists))
        found.pop(chance.randrange(len(found))) if chance.random() < 0.5 else found.append(found[0])
    return json.dumps(whole).encode()


ROOTS = (b"[]", b"null", b"{}", b"1", b'"x"', b"\xff\xfe{\0}\0", b"\xef\xbb\xbf{}", b"{,}", b"'a'")
JSON: dict[str, Damage] = BYTES | {
    "wrong type": lambda c, content: replaced(c, content, json.dumps(c.choice(OTHER_VALUES))),
    "odd number": lambda c, content: replaced(c, content, c.choice(NUMBERS), (int, float)),
    "odd text": lambda c, content: replaced(c, content, json.dumps(c.choice(TEXTS)), str),
    "deep nesting": deep,
    "missing key": with_key(lambda chance, record, key: record.pop(key)),
    "other key": with_key(renamed),
    "key twice": twice,
    "list of another length": short_list,
    "another root": lambda chance, content: chance.choice(ROOTS),
}


# Images.


def saved(image: Image.Image, kind: str, **more: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **more)
    return file.getvalue()


def opened(content: bytes) -> Image.Image:
    return Image.open(io.BytesIO(content)).convert("RGB")


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(side: int, bits: int, colour: int, data: bytes) -> bytes:
    """Return a square PNG of compressed rows, which may be of a kind that Pillow does not write."""
    header = struct.pack(">IIBBBBB", side, side, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


SIZES = (
    (LARGE, LARGE), (2**31 - 1, 1), (1, 2**31 - 1), (0, 5), (12_000, 12_000), (9000, 9000), (25, 24),
)  # fmt: skip
MODES = (
    ("L", "PNG"), ("LA", "PNG"), ("P", "PNG"), ("P", "GIF"), ("1", "PNG"), ("CMYK", "JPEG"), ("F", "TIFF"), ("I", "TIFF"),
    ("I;16", "PNG"), ("YCbCr", "JPEG"), ("LAB", "TIFF"), ("RGB", "BMP"), ("RGB", "WEBP"), ("L", "PPM"),
)  # fmt: skip


def size_in_header(chance: Random, content: bytes) -> bytes:
    """Return a PNG with another size in its header, and a correct checksum."""
    header = struct.pack(">II", *chance.choice(SIZES)) + content[24:29]
    return content[:8] + chunk(b"IHDR", header) + content[33:]


def of_mode(chance: Random, content: bytes) -> bytes:
    """Return an image of another kind: grey, palette, CMYK, of 1 or 32 bits, floating point, YCbCr."""
    mode, kind = chance.choice(MODES)
    image = opened(content)
    return saved((image.convert("I") if mode == "I;16" else image).convert(mode), kind)


def sixteen_bits(chance: Random, content: bytes) -> bytes:
    """Return a PNG of 16 bits per channel with 2 to 4 channels."""
    colour, count = chance.choice(((2, 3), (4, 2), (6, 4)))
    return png(
        24, 16, colour, zlib.compress(b"".join(b"\0" + chance.randbytes(48 * count) for _ in range(24)))
    )


def animated(chance: Random, content: bytes) -> bytes:
    images = [Image.new("RGB", (24, 24), (i, 0, 0)) for i in range(3)]
    kind = chance.choice(("GIF", "PNG", "WEBP", "TIFF"))
    return saved(images[0], kind, save_all=True, append_images=images[1:])


def one_pixel(chance: Random, content: bytes) -> bytes:
    return saved(Image.new("RGB", chance.choice(((1, 1), (1, 24), (24, 1)))), chance.choice(("PNG", "JPEG")))


def zeros_png(side: int, colour: int = 0, channels: int = 1) -> bytes:
    """Return a PNG of ``side`` squared black pixels, a thousandth of their size."""
    return png(side, 8, colour, zlib.compress(b"\0" * (side * (side * channels + 1)), 9))


def exif_noise(chance: Random, content: bytes) -> bytes:
    exif = b"Exif\0\0II*\0\x08\0\0\0" + chance.randbytes(chance.choice((2, 40, 400)))
    return saved(opened(content), "JPEG", exif=exif)


def long_text(chance: Random, content: bytes) -> bytes:
    """Return a PNG whose compressed text is a thousand times as long as the file."""
    return content[:33] + chunk(b"zTXt", b"k\0\0" + zlib.compress(b"a" * 50_000_000)) + content[33:]


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 24 24\n%%EndComments\n{} loop\n"
IMAGES: dict[str, Damage] = BYTES | {
    "size in the header": size_in_header,
    "another mode": of_mode,
    "16 bits per channel": sixteen_bits,
    "animated": animated,
    "one pixel or line": one_pixel,
    "compressed zeros": lambda chance, content: zeros_png(chance.choice((4000, 12_000))),
    "part of a JPEG": lambda c, content: c.choice((cut, flipped))(c, saved(opened(content), "JPEG")),
    "EXIF of noise": exif_noise,
    "long compressed text": long_text,
    "PostScript": lambda chance, content: POSTSCRIPT,
}


# Arrays of numpy, as depth and as points.

SHAPES = ((24, 24), (24, 25), (24, 24, 3), (0, 24), (), (24,), (576, 3), (0, 3), (1, 3))
KINDS = ("f2", "f4", "f8", "i1", "u2", "i4", "u8", "c16", "U3", "S2", "?", "M8[s]", "f4,i4", ">f4")
VALUES = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e10, 3.4e38, 1e308, 1e-320, 65.535)
HEADER_SHAPES = (
    "(100000, 100000)", "(1000000000000,)", "(-1, 24)", "(24, 24)" * 3, "(" * 500, f"({'9' * 50}, 3)", "(1, 2",
)  # fmt: skip


def array_bytes(array: Any, allow_pickle: bool = False) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=allow_pickle)
    return file.getvalue()


def array_file(kind: str, shape: str, content: bytes) -> bytes:
    """Return an array file with any header."""
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header + content


def another_array(chance: Random, content: bytes) -> bytes:
    shape, kind = chance.choice(SHAPES), chance.choice(KINDS)
    return array_bytes(np.zeros(shape, kind) if kind == "f4,i4" else np.ones(shape).astype(kind))


def odd_values(chance: Random, content: bytes) -> bytes:
    values = np.full((24, 24), chance.choice(VALUES))
    return array_bytes(values if chance.random() < 0.5 else values.reshape(-1, 3))


def pickled(chance: Random, content: bytes) -> bytes:
    return array_bytes(np.array([{"a": 1}, None], dtype=object), allow_pickle=True)


def array_header(chance: Random, content: bytes) -> bytes:
    """Return an array file whose header promises more than any memory holds, or is no header."""
    kind = chance.choice(("<f8", "<f4", "O", "V1000000000", "x", "\\x1b[31m"))
    return array_file(kind, chance.choice(HEADER_SHAPES), b"\0" * 100)


def archive(chance: Random, content: bytes) -> bytes:
    file = io.BytesIO()
    name = chance.choice(("points.npy", "points", "other.npy", "T_camera_sensor.npy", PLAIN_TERMINAL))
    damage = chance.choice((another_array, odd_values, pickled, array_header, noise))
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as parts:
        parts.writestr(name, damage(chance, content))
        if chance.random() < 0.3:
            parts.writestr("T_camera_sensor.npy", another_array(chance, content))
        if chance.random() < 0.2:
            bomb = array_file("<f8", "(100000000, 3)", b"\0" * 40_000_000)
            parts.writestr("points.npy" if name != "points.npy" else "more.npy", bomb)
    return file.getvalue()


ARRAYS: dict[str, Damage] = BYTES | {
    "another array": another_array,
    "odd values": odd_values,
    "pickled": pickled,
    "header of an array": array_header,
    "archive": archive,
}
ROWS = (
    b"1 2\n3 4\n", b"1,5 2,5\n", b"nan inf 1\n", b"a b c\n", b"1 2 3\n4 5\n", b"# \x1b[2J\n", b"1e400 0 1\n", b"0 0 0\n",
    b"1 2 3 " * 20_000, b"1_0 2 3\n", b"\xff\xfe1 2 3\n", b"1;2;3\n", b"-1 -2 -3\n", b"\0\0\0",
)  # fmt: skip
POINTS: dict[str, Damage] = BYTES | {"odd points": lambda chance, content: chance.choice(ROWS)}


# Tensors, in the format of safetensors: the length of a header, a header of JSON, numbers.


def parts_of(content: bytes) -> tuple[dict[str, Any], bytes]:
    length = struct.unpack("<Q", content[:8])[0]
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def joined(header: bytes | dict[str, Any], numbers: bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + numbers


def header_length(chance: Random, content: bytes) -> bytes:
    return struct.pack("<Q", chance.choice((0, 1, 2**63, 2**64 - 1, 10**8, len(content)))) + content[8:]


def damaged_header(chance: Random, content: bytes) -> bytes:
    header, numbers = parts_of(content)
    damage = chance.choice([damage for name, damage in JSON.items() if name not in ("deep nesting", "empty")])
    return joined(damage(chance, json.dumps(header).encode()), numbers)


TYPES = ("F8_E4M3", "F64", "BF16", "I32", "U8", "BOOL", "F4", "C64", "X", "\x1b[2J")


def another_type(chance: Random, header: dict[str, Any], numbers: bytes, name: str) -> bytes:
    header[name]["dtype"] = chance.choice(TYPES)
    return joined(header, numbers)


def another_shape(chance: Random, header: dict[str, Any], numbers: bytes, name: str) -> bytes:
    shape = header[name]["shape"]
    shapes = ([*shape, 1], shape[::-1], [], [-1], [2**62, 4], [0], [int(np.prod(shape))])
    header[name]["shape"] = chance.choice(shapes)
    return joined(header, numbers)


def not_finite(chance: Random, header: dict[str, Any], numbers: bytes, name: str) -> bytes:
    """Fill a tensor with NaN, whatever its type: all bits set."""
    begin, end = header[name]["data_offsets"]
    return joined(header, numbers[:begin] + b"\xff" * (end - begin) + numbers[end:])


def another_name(chance: Random, header: dict[str, Any], numbers: bytes, name: str) -> bytes:
    header[chance.choice((TERMINAL.replace("\ud800", ""), "other", ""))] = header.pop(name)
    return joined(header, numbers)


def random_numbers(chance: Random, header: dict[str, Any], numbers: bytes, name: str) -> bytes:
    begin = chance.randrange(len(numbers))
    end = min(len(numbers), begin + chance.choice((1, 4, 1000)))
    return joined(header, numbers[:begin] + chance.randbytes(end - begin) + numbers[end:])


def _of_tensor(damage: Callable[[Random, dict[str, Any], bytes, str], bytes]) -> Damage:
    def damaged(chance: Random, content: bytes) -> bytes:
        header, numbers = parts_of(content)
        name = chance.choice([name for name in header if name != "__metadata__"])
        return damage(chance, copy.deepcopy(header), numbers, name)

    return damaged


TENSORS: dict[str, Damage] = BYTES | {
    "length of the header": header_length,
    "header of tensors": damaged_header,
    "another type": _of_tensor(another_type),
    "another shape": _of_tensor(another_shape),
    "not finite": _of_tensor(not_finite),
    "another name": _of_tensor(another_name),
    "random numbers": _of_tensor(random_numbers),
}


# COLMAP's binary files, which begin with a count of 64 bits.


def with_count(count: int, content: bytes, place: int = 0) -> bytes:
    """Return the content with another count of 64 bits at a place."""
    return content[:place] + struct.pack("<Q", count % 2**64) + content[place + 8 :]


def counts(content: bytes) -> dict[str, Damage]:
    """Return the false counts of a file: of more than it holds, of fewer, negative, and of more than any memory."""
    held = struct.unpack_from("<Q", content)[0]
    false = {
        "2^63": 2**63, "-1": -1, "2^31": 2**31, "10^6": 10**6, "more than it holds": held + 1, "fewer": held - 1, "none": 0,
    }  # fmt: skip
    return {
        f"count {name}": partial(lambda number, c, content: with_count(number, content), number)
        for name, number in false.items()
    }
