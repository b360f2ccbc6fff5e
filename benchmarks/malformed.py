"""Malformed files, drawn at random: JSON, images, arrays, tensors and points with typical damage.

Each table maps the name of a kind of damage to a function of a ``random.Random`` and of the sound content, which returns
the damaged content. ``fuzz.py`` and ``tests/test_fuzz.py`` put such files in place of sound ones.
"""

from __future__ import annotations

import copy
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable
from random import Random
from typing import Any, TypeAlias

import numpy as np
from PIL import Image

Damage: TypeAlias = Callable[[Random, bytes], bytes]

TERMINAL = "\x1b[2J\x1b]0;owned\x07\x9b31m\x00\r\u202e\ud800\u2028"
"""Text that clears a terminal, sets its title, and colours and reverses what follows; it has half of a surrogate pair."""
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


# Bytes of any kind.


def cut(chance: Random, content: bytes) -> bytes:
    return content[: chance.randrange(max(1, len(content)))]


def flipped(chance: Random, content: bytes) -> bytes:
    """Change some bytes."""
    changed = bytearray(content or b"\0")
    for _ in range(chance.choice((1, 1, 2, 8, 64))):
        changed[chance.randrange(len(changed))] = chance.randrange(256)
    return bytes(changed)


def noise(chance: Random, content: bytes) -> bytes:
    return chance.randbytes(chance.choice((1, 7, 100, 4096)))


def empty(chance: Random, content: bytes) -> bytes:
    return b""


def appended(chance: Random, content: bytes) -> bytes:
    return content + noise(chance, content)


BYTES: dict[str, Damage] = {
    "cut": cut,
    "flipped": flipped,
    "noise": noise,
    "empty": empty,
    "appended": appended,
}


# JSON. A marker replaces a value, and is itself replaced in the text, since Python's JSON does not write 1e400.

MARKER = "@marker@"


def places_of(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths of all values inside ``value``."""
    inside = enumerate(value) if isinstance(value, list) else value.items() if isinstance(value, dict) else ()
    return [place for key, item in inside for place in ((*path, key), *places_of(item, (*path, key)))]


def replaced(chance: Random, content: bytes, text: str, kinds: type | tuple[type, ...] = object) -> bytes:
    """Put JSON ``text`` in the place of a random value of one of ``kinds``."""
    whole = copy.deepcopy(json.loads(content))
    places = [place for place in places_of(whole) if isinstance(at(whole, place), kinds)]
    if not places:
        return text.encode(errors="surrogatepass")
    *outer, last = chance.choice(places)
    at(whole, tuple(outer))[last] = MARKER
    return json.dumps(whole).replace(json.dumps(MARKER), text).encode(errors="surrogatepass")


def at(value: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        value = value[key]
    return value


def wrong_type(chance: Random, content: bytes) -> bytes:
    return replaced(chance, content, json.dumps(chance.choice(OTHER_VALUES)))


def odd_number(chance: Random, content: bytes) -> bytes:
    return replaced(chance, content, chance.choice(NUMBERS), (int, float))


def odd_text(chance: Random, content: bytes) -> bytes:
    return replaced(chance, content, json.dumps(chance.choice(TEXTS)), str)


def deep(chance: Random, content: bytes) -> bytes:
    depth = chance.choice((50, 900, 5000, 100_000))
    opening, closing = chance.choice((("[", "]"), ('{"a":', "}")))
    return replaced(chance, content, opening * depth + "1" + closing * depth)


def missing_key(chance: Random, content: bytes) -> bytes:
    whole = json.loads(content)
    places = [place for place in places_of(whole) if isinstance(place[-1], str)]
    if places:
        *outer, last = chance.choice(places)
        del at(whole, tuple(outer))[last]
    return json.dumps(whole).encode()


def other_key(chance: Random, content: bytes) -> bytes:
    """Rename a key, to a name with control characters or a typing error."""
    whole = json.loads(content)
    places = [place for place in places_of(whole) if isinstance(place[-1], str)]
    if places:
        *outer, last = chance.choice(places)
        record = at(whole, tuple(outer))
        record[chance.choice((TERMINAL, last + "s", last.upper(), ""))] = record.pop(last)
    return json.dumps(whole).encode()


def twice(chance: Random, content: bytes) -> bytes:
    """Give a key two values."""
    whole = json.loads(content)
    if not isinstance(whole, dict) or not whole:
        return content
    key = chance.choice(list(whole))
    more = json.dumps(chance.choice(OTHER_VALUES))
    return f"{json.dumps(whole)[:-1]}, {json.dumps(key)}: {more}}}".encode()


def short_list(chance: Random, content: bytes) -> bytes:
    whole = json.loads(content)
    lists = [place for place in places_of(whole) if isinstance(at(whole, place), list) and at(whole, place)]
    if lists:
        found = at(whole, chance.choice(lists))
        found.pop(chance.randrange(len(found))) if chance.random() < 0.5 else found.append(found[0])
    return json.dumps(whole).encode()


def another_root(chance: Random, content: bytes) -> bytes:
    return chance.choice(
        (b"[]", b"null", b"{}", b"1", b'"x"', b"\xff\xfe{\0}\0", b"\xef\xbb\xbf{}", b"{,}", b"'a'")
    )


JSON: dict[str, Damage] = BYTES | {
    "wrong type": wrong_type,
    "odd number": odd_number,
    "odd text": odd_text,
    "deep nesting": deep,
    "missing key": missing_key,
    "other key": other_key,
    "key twice": twice,
    "list of another length": short_list,
    "another root": another_root,
}


# Images.


def saved(image: Image.Image, kind: str, **more: Any) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **more)
    return file.getvalue()


def size_in_header(chance: Random, content: bytes) -> bytes:
    """Return a PNG with another size in its header, and a correct checksum."""
    width, height = chance.choice(
        ((LARGE, LARGE), (2**31 - 1, 1), (1, 2**31 - 1), (0, 5), (12_000, 12_000), (9000, 9000), (25, 24))
    )
    header = struct.pack(">II", width, height) + content[24:29]
    return content[:16] + header + struct.pack(">I", zlib.crc32(b"IHDR" + header)) + content[33:]


def of_mode(chance: Random, content: bytes) -> bytes:
    """Return an image of another kind: grey, palette, CMYK, of 1 or 32 bits, floating point, YCbCr."""
    image = Image.open(io.BytesIO(content)).convert("RGB")
    mode, kind = chance.choice(
        (("L", "PNG"), ("LA", "PNG"), ("P", "PNG"), ("P", "GIF"), ("1", "PNG"), ("CMYK", "JPEG"), ("F", "TIFF"), ("I", "TIFF"),
         ("I;16", "PNG"), ("YCbCr", "JPEG"), ("LAB", "TIFF"), ("RGB", "BMP"), ("RGB", "WEBP"), ("L", "PPM"))
    )  # fmt: skip
    changed = image.convert("I").convert(mode) if mode == "I;16" else image.convert(mode)
    return saved(changed, kind)


def sixteen_bits(chance: Random, content: bytes) -> bytes:
    """Return a PNG of 16 bits a channel with 2 to 4 channels, which Pillow does not write."""
    colour, count = chance.choice(((2, 3), (4, 2), (6, 4)))
    side = 24
    rows = b"".join(b"\0" + chance.randbytes(side * count * 2) for _ in range(side))
    return png(struct.pack(">IIBBBBB", side, side, 16, colour, 0, 0, 0), zlib.compress(rows))


def png(header: bytes, data: bytes) -> bytes:
    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def animated(chance: Random, content: bytes) -> bytes:
    images = [Image.new("RGB", (24, 24), (i, 0, 0)) for i in range(3)]
    kind = chance.choice(("GIF", "PNG", "WEBP", "TIFF"))
    return saved(images[0], kind, save_all=True, append_images=images[1:])


def one_pixel(chance: Random, content: bytes) -> bytes:
    return saved(Image.new("RGB", chance.choice(((1, 1), (1, 24), (24, 1)))), chance.choice(("PNG", "JPEG")))


def compressed_zeros(chance: Random, content: bytes) -> bytes:
    """Return a small PNG of many pixels, one byte of data for a thousand bytes of the image."""
    side = chance.choice((4000, 12_000))
    return png(
        struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0), zlib.compress(b"\0" * (side * (side + 1)), 9)
    )


def jpeg_part(chance: Random, content: bytes) -> bytes:
    whole = saved(Image.open(io.BytesIO(content)).convert("RGB"), "JPEG")
    return chance.choice((cut, flipped))(chance, whole)


def exif_noise(chance: Random, content: bytes) -> bytes:
    exif = b"Exif\0\0II*\0\x08\0\0\0" + chance.randbytes(chance.choice((2, 40, 400)))
    return saved(Image.open(io.BytesIO(content)).convert("RGB"), "JPEG", exif=exif)


def text_chunk(chance: Random, content: bytes) -> bytes:
    """Return a PNG whose compressed text is a thousand times as long as the file."""
    body = b"k\0\0" + zlib.compress(b"a" * 50_000_000)
    chunk = struct.pack(">I", len(body)) + b"zTXt" + body + struct.pack(">I", zlib.crc32(b"zTXt" + body))
    return content[:33] + chunk + content[33:]


IMAGES: dict[str, Damage] = BYTES | {
    "size in the header": size_in_header,
    "another mode": of_mode,
    "16 bits a channel": sixteen_bits,
    "animated": animated,
    "one pixel or line": one_pixel,
    "compressed zeros": compressed_zeros,
    "part of a JPEG": jpeg_part,
    "EXIF of noise": exif_noise,
    "long compressed text": text_chunk,
}


# Arrays of numpy, as depth and as points.


def array_bytes(array: Any, allow_pickle: bool = False) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=allow_pickle)
    return file.getvalue()


def another_array(chance: Random, content: bytes) -> bytes:
    shape = chance.choice(((24, 24), (24, 25), (24, 24, 3), (0, 24), (), (24,), (576, 3), (0, 3), (1, 3)))
    kind = chance.choice(
        ("f2", "f4", "f8", "i1", "u2", "i4", "u8", "c16", "U3", "S2", "?", "M8[s]", "f4,i4", ">f4")
    )
    return array_bytes(np.ones(shape).astype(kind) if kind != "f4,i4" else np.zeros(shape, kind))


def odd_values(chance: Random, content: bytes) -> bytes:
    values = np.full(
        (24, 24), chance.choice((np.nan, np.inf, -np.inf, -1.0, 0.0, 1e10, 3.4e38, 1e308, 1e-320, 65.535))
    )
    return array_bytes(values if chance.random() < 0.5 else values.reshape(-1, 3))


def pickled(chance: Random, content: bytes) -> bytes:
    return array_bytes(np.array([{"a": 1}, None], dtype=object), allow_pickle=True)


def array_header(chance: Random, content: bytes) -> bytes:
    """Return an array file whose header promises more than any memory holds, or is no header."""
    shape = chance.choice(
        (
            "(100000, 100000)",
            "(1000000000000,)",
            "(-1, 24)",
            "(24, 24)" * 3,
            "(" * 500,
            f"({'9' * 50}, 3)",
            "(1, 2",
        )
    )
    kind = chance.choice(("<f8", "<f4", "O", "V1000000000", "x", "\\x1b[31m"))
    header = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header + b"\0" * 100


def archive(chance: Random, content: bytes) -> bytes:
    file = io.BytesIO()
    name = chance.choice(
        (
            "points.npy",
            "points",
            "other.npy",
            "T_camera_sensor.npy",
            TERMINAL.replace("\ud800", "").replace("\0", ""),
        )
    )
    damage = chance.choice((another_array, odd_values, pickled, array_header, noise))
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as parts:
        parts.writestr(name, damage(chance, content))
        if chance.random() < 0.3:
            parts.writestr("T_camera_sensor.npy", another_array(chance, content))
        if chance.random() < 0.2:
            header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (100000000, 3), }"
            bomb = b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header + b"\0" * 40_000_000
            parts.writestr("points.npy" if name != "points.npy" else "more.npy", bomb)
    return file.getvalue()


ARRAYS: dict[str, Damage] = BYTES | {
    "another array": another_array,
    "odd values": odd_values,
    "pickled": pickled,
    "header of an array": array_header,
    "archive": archive,
}


def odd_points(chance: Random, content: bytes) -> bytes:
    rows = chance.choice((b"1 2\n3 4\n", b"1,5 2,5\n", b"nan inf 1\n", b"a b c\n", b"1 2 3\n4 5\n", b"# \x1b[2J\n", b"1e400 0 1\n",
                          b"0 0 0\n", b"1 2 3 " * 20_000, b"1_0 2 3\n", b"\xff\xfe1 2 3\n", b"1;2;3\n", b"-1 -2 -3\n", b"\0\0\0"))  # fmt: skip
    return rows


POINTS: dict[str, Damage] = BYTES | {"odd points": odd_points}


# Tensors, in the format of safetensors: the length of a header, a header of JSON, numbers.


def parts_of(content: bytes) -> tuple[dict[str, Any], bytes]:
    length = struct.unpack("<Q", content[:8])[0]
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def joined(header: bytes, numbers: bytes, length: int | None = None) -> bytes:
    return struct.pack("<Q", len(header) if length is None else length) + header + numbers


def header_length(chance: Random, content: bytes) -> bytes:
    return struct.pack("<Q", chance.choice((0, 1, 2**63, 2**64 - 1, 10**8, len(content)))) + content[8:]


def damaged_header(chance: Random, content: bytes) -> bytes:
    header, numbers = parts_of(content)
    damage = chance.choice([damage for name, damage in JSON.items() if name not in ("deep nesting", "empty")])
    return joined(damage(chance, json.dumps(header).encode()), numbers)


def another_type(chance: Random, content: bytes) -> bytes:
    header, numbers = parts_of(content)
    name = chance.choice([name for name in header if name != "__metadata__"])
    header[name]["dtype"] = chance.choice(
        ("F8_E4M3", "F64", "BF16", "I32", "U8", "BOOL", "F4", "C64", "X", "\x1b[2J")
    )
    return joined(json.dumps(header).encode(), numbers)


def another_shape(chance: Random, content: bytes) -> bytes:
    header, numbers = parts_of(content)
    name = chance.choice([name for name in header if name != "__metadata__"])
    shape = header[name]["shape"]
    header[name]["shape"] = chance.choice(
        ([*shape, 1], shape[::-1], [], [-1], [2**62, 4], [0], [int(np.prod(shape))])
    )
    return joined(json.dumps(header).encode(), numbers)


def not_finite(chance: Random, content: bytes) -> bytes:
    """Fill a tensor with NaN, whatever its type: all bits set."""
    header, numbers = parts_of(content)
    name = chance.choice([name for name in header if name != "__metadata__"])
    begin, end = header[name]["data_offsets"]
    return joined(json.dumps(header).encode(), numbers[:begin] + b"\xff" * (end - begin) + numbers[end:])


def renamed_tensor(chance: Random, content: bytes) -> bytes:
    header, numbers = parts_of(content)
    name = chance.choice([name for name in header if name != "__metadata__"])
    header[chance.choice((TERMINAL.replace("\ud800", ""), "other", ""))] = header.pop(name)
    return joined(json.dumps(header).encode(), numbers)


def random_numbers(chance: Random, content: bytes) -> bytes:
    header, numbers = parts_of(content)
    begin = chance.randrange(len(numbers))
    end = min(len(numbers), begin + chance.choice((1, 4, 1000)))
    return joined(
        json.dumps(header).encode(), numbers[:begin] + chance.randbytes(end - begin) + numbers[end:]
    )


TENSORS: dict[str, Damage] = BYTES | {
    "length of the header": header_length,
    "header of tensors": damaged_header,
    "another type": another_type,
    "another shape": another_shape,
    "not finite": not_finite,
    "another name": renamed_tensor,
    "random numbers": random_numbers,
}
