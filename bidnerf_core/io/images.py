"""Image files and pixel arrays as tensors. Every image file that the library reads is decoded here."""

from __future__ import annotations

import contextlib
import math
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Shaped
from PIL import Image, TiffImagePlugin, UnidentifiedImageError, WebPImagePlugin  # noqa: F401 (these register formats)
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.installation import import_extra
from bidnerf_core.io.allowance import Allowance
from bidnerf_core.io.files import PackedFile, open_binary, reason

Background: TypeAlias = str | Sequence[float]
"""A background as users give it: "white", "black" or an rgb triple in [0, 1]."""

ImageSource: TypeAlias = Path | PackedFile
"""An image file, or an image inside an archive."""

LARGEST_IMAGE = 178_000_000
"""Largest number of pixels, the most that Pillow opens: a small file can describe an image of any size, so the size is checked
before memory is allocated."""
STRIP = 2**21
"""Number of pixels converted at a time: conversion takes many times as much memory as the image's bytes."""
FORMATS = ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "GIF", "AVIF", "HEIF")
"""The formats that are decoded, whatever a file's name. Pillow supports more, and reads EPS by starting
another program."""
CONVERTED = ("CMYK", "YCbCr", "HSV")
"""Colour spaces that Pillow converts to RGB."""

# Pillow warns about large images, odd EXIF and palettes, which is of no use to a user who opens a photo. The
# filter is set once and with the lowest precedence: filters belong to the whole process, so threads that
# changed and restored them while reading images would leave each other's filters behind.
warnings.filterwarnings("ignore", module=r"PIL\.", append=True)
FULL_SCALE = {"bool": 1, "uint8": 255, "uint16": 65535}
COLOUR_ROUNDING = 1e-3
"""Amount by which a floating-point channel may lie outside [0, 1], as after resampling and colour conversion."""


@dataclass(frozen=True)
class ImageHeader:
    """The properties of an image file that are known before its pixels are decoded."""

    width: int
    height: int
    has_alpha: bool
    deep_grey: bool = False  # one channel of more than 8 bits, as in depth images

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height


def read_header(path: ImageSource) -> ImageHeader:
    """Read the size of an image and what its channels are, but no pixels. Raises ``InputError`` as ``open_image`` does."""
    with open_image(path) as image:
        has_alpha = image.mode in ("LA", "RGBA", "PA") or (image.mode == "P" and image.has_transparency_data)
        return ImageHeader(image.width, image.height, has_alpha, image.mode[:1] in "IF")


def find_header(path: ImageSource) -> ImageHeader | None:
    """Return what ``read_header`` does, or None if the image is unreadable, which is an error only when its pixels are read."""
    with contextlib.suppress(InputError):
        return read_header(path)
    return None


def read_image(
    path: ImageSource, background: Sequence[float] = (0.0, 0.0, 0.0), size: tuple[int, int] | None = None
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"] | None]:
    """Read colour in [0, 1] composited over ``background``, and alpha if there is an alpha channel.

    Grey becomes three channels, CMYK becomes RGB, and 16-bit values are scaled by the sensor's range: 10, 12
    or 14 bits if no value needs more. The image is returned as stored, ignoring the EXIF orientation, and downscaled
    to ``size`` (width, height) as by ``reduce_image``. It is converted in strips, so that only its bytes and
    the result are in memory. Raises ``InputError`` if the file is not a complete image with 1 to 4 channels of
    8 or 16 bits, or is too large.
    """
    rgb, alpha = list[Tensor](), list[Tensor]()
    with open_image(path) as image:
        width, height = image.size if size is None else size
        Allowance.of(path, "an image").take(16 * width * height)  # the bytes and the numbers of a pixel
        if image.mode == "F":  # such as depth
            raise InputError(
                "image is of float32", where=path, expected="grey, RGB or RGBA with 8 or 16 bits per channel"
            )
        for strip, white in _strips(path, image):
            colour, cover = split_alpha(pixel_array(strip, f"{path}: image", white))
            rgb.append(reduce_image(composite(colour, cover, background), width, len(strip)))
            if cover is not None:
                alpha.append(reduce_image(cover, width, len(strip)))
    return reduce_image(torch.cat(rgb), width, height), reduce_image(torch.cat(alpha), width, height) if alpha else None


def read_compact_image(
    path: ImageSource, background: Sequence[float] = (0.0, 0.0, 0.0), size: tuple[int, int] | None = None
) -> tuple[Shaped[Tensor, "h w 3"], Float[Tensor, "h w"] | None]:
    """Read an image like ``read_image``, but keep colours as bytes (uint8) if the file has 8 bits and no alpha.

    Images downscaled to ``size`` (width, height) are bytes as well; a JPEG file is decoded at no higher
    resolution than needed.
    """
    with open_image(path) as image:
        if image.mode in ("L", "RGB", *CONVERTED) and not _is_deep(image):
            if size is not None and image.format == "JPEG":
                # JPEG decodes to a half, a quarter or an eighth along each side. Images whose sizes are not multiples are decoded
                # whole, since their last column or row would be weighted too heavily.
                sides = [tuple(side // f for side in image.size if side % f == 0) for f in (8, 4, 2)]
                fitting = [s for s in sides if len(s) == 2 and s[0] >= size[0] and s[1] >= size[1]]
                image.draft(image.mode, fitting[0] if fitting else image.size)
            pixels = torch.from_numpy(_pixels(path, image))
            found = pixels if size is None else reduce_image(pixels, *size)
            return (found if found.ndim == 3 else found[..., None].repeat(1, 1, 3)), None
    rgb, alpha = read_image(path, background, size)
    return rgb if size is None else (rgb * FULL_SCALE["uint8"]).round_().to(torch.uint8), alpha


def split_alpha(values: Float[Tensor, "h w c"]) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"] | None]:
    """Split grey, grey with alpha, RGB or RGBA (1 to 4 channels) into colour and alpha."""
    count = values.shape[-1]
    alpha = values[..., -1].clone() if count in (2, 4) else None
    colour = values[..., : count - 1] if alpha is not None else values
    return colour.expand(*colour.shape[:2], 3).contiguous(), alpha


def pixel_array(pixels: np.ndarray | Tensor, what: str, white: int | None = None) -> Float[Tensor, "h w c"]:
    """Scale a pixel array, grey (h, w) or with 1 to 4 channels in the last axis, to [0, 1].

    Accepts uint8 in [0, 255], uint16 in [0, 65535], bool, and floats in [0, 1]; ``white`` is the integer value of white, by
    default the largest of the type. Raises ``InputError``, whose message begins with ``what``, for other types and shapes, for
    NaN, and for floats outside [0, 1].
    """
    raw = to_numpy(pixels)
    is_float = raw.dtype.kind == "f"
    found, expected = "", "uint8 in [0, 255], uint16 or floats in [0, 1]"
    if raw.ndim not in (2, 3) or 0 in raw.shape or (raw.ndim == 3 and raw.shape[2] > 4):
        hint = "; move the channels last" if raw.ndim == 3 and raw.shape[0] <= 4 else ""
        found, expected = f"shape {raw.shape}", f"(height, width) or (height, width, 1 to 4){hint}"
    elif not is_float and raw.dtype.name not in FULL_SCALE:
        found = f"dtype {raw.dtype.name}"
    elif is_float and not (raw.min() >= -COLOUR_ROUNDING and raw.max() <= 1 + COLOUR_ROUNDING):  # also NaN
        hint = "; divide by 255, or give uint8" if 1 < raw.max() <= 255 and raw.min() >= 0 else ""
        found, expected = f"floats from {raw.min():g} to {raw.max():g}", f"[0, 1]{hint}"
    if found:
        raise InputError(f"{what} has {found}", expected=expected)
    scaled = raw.reshape(*raw.shape[:2], -1).astype(np.float32)
    scaled /= white or FULL_SCALE.get(raw.dtype.name, 1)
    return torch.from_numpy(scaled).clamp_(0, 1)


def to_numpy(array: np.ndarray | Tensor) -> np.ndarray:
    """Convert an array or tensor (any device and dtype) to NumPy. Raises ``InputError`` if NumPy cannot convert it."""
    if not isinstance(array, Tensor):
        try:
            return np.asarray(array)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"got an object of type {type(array).__name__}", expected="an array of numbers") from error
    values = array.detach().cpu()
    return (values.float() if values.dtype == torch.bfloat16 else values).numpy()


def composite(
    colour: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"] | None, background: Sequence[float]
) -> Float[Tensor, "h w 3"]:
    """Composite straight (not premultiplied) colour over ``background``."""
    if alpha is None:
        return colour
    cover = alpha[..., None]
    return colour * cover + colour.new_tensor(background) * (1 - cover)


def background_colour(background: Background) -> tuple[float, float, float]:
    """Return the rgb triple for ``background``. Raises ``InputError`` if it is not a colour."""
    expected, named = '"white", "black" or three numbers in [0, 1]', {"black": 0.0, "white": 1.0}
    if isinstance(background, str):
        if background not in named:
            raise InputError(f"background is {background!r}", expected=expected)
        background = (named[background],) * 3
    values = tuple(float(value) for value in background)
    if len(values) != 3 or not all(math.isfinite(value) and 0 <= value <= 1 for value in values):
        raise InputError(f"background is {values}", expected=expected)
    return values[0], values[1], values[2]


def reduce_image(image: Shaped[Tensor, "h w *c"], width: int, height: int) -> Shaped[Tensor, "nh nw *c"]:
    """Downscale an image of floats or bytes; each new pixel is the mean over the area that it covers.

    An image that already has this size is returned unchanged.
    """
    import cv2  # imported here, since most images keep their size

    if tuple(image.shape[:2]) == (height, width):
        return image
    small = cv2.resize(image.numpy(), (width, height), interpolation=cv2.INTER_AREA)
    return torch.from_numpy(small.reshape(height, width, *image.shape[2:]))


def resample_nearest(image: Shaped[Tensor, "h w"], width: int, height: int) -> Shaped[Tensor, "nh nw"]:
    """Resize an image by nearest-neighbour sampling."""
    rows = ((torch.arange(height) + 0.5) * image.shape[0] / height).long()
    columns = ((torch.arange(width) + 0.5) * image.shape[1] / width).long()
    return image[rows][:, columns]


def decode(path: ImageSource, pixel: int = 16) -> np.ndarray:
    """Decode the first image of a file as stored: (h, w) or (h, w, channels) in the file's own type.

    ``pixel`` is the number of bytes that the caller needs for each pixel. Raises ``InputError`` if the file is not a complete
    image, for colour spaces other than grey and RGB, and if the pixels take too much memory (see ``Allowance``).
    """
    with open_image(path) as image:
        Allowance.of(path, "an image").take(pixel * image.width * image.height)
        return _pixels(path, image)


def _strips(path: ImageSource, image: Image.Image) -> Iterator[tuple[np.ndarray, int | None]]:
    """Yield strips of an open image from top to bottom, each with the value of white, or None for the maximum of the type."""
    rows = max(1, STRIP // image.width)
    if not _is_deep(image):
        for top in range(0, image.height, rows):
            yield _pixels(path, image.crop((0, top, image.width, min(top + rows, image.height)))), None
        return
    whole = _pixels(path, image)
    # Values of 10, 12 or 14 bits are stored in 16; the fewest bits that fit the largest value are assumed. Images with alpha use all 16.
    has_alpha = whole.ndim == 3 and whole.shape[2] in (2, 4)
    bits = next((bits for bits in (10, 12, 14) if whole.max(initial=0) < 2**bits and not has_alpha), 16)
    for top in range(0, len(whole), rows):
        yield whole[top : top + rows], 2**bits - 1


def _is_deep(image: Image.Image) -> bool:
    """Return whether an open image has 16 bits per channel; Pillow reduces images with several such channels to 8 bits."""
    return image.mode.startswith("I;16") or (image.format == "PNG" and image.mode == "I") or _is_deep_colour(image)


def _is_deep_colour(image: Image.Image) -> bool:
    tiles = getattr(image, "tile", [])
    arguments = tiles[0][3] if tiles else ""
    raw = arguments[0] if isinstance(arguments, tuple) and arguments else arguments
    return image.mode in ("LA", "RGB", "RGBA", "RGBX") and isinstance(raw, str) and ";16" in raw


def _pixels(path: ImageSource, image: Image.Image) -> np.ndarray:
    """Return the pixels of an image as stored, (h, w) or (h, w, channels)."""
    if image.mode == "LAB":
        raise InputError(f"image is {image.mode}", where=path, expected="grey, RGB, RGBA or CMYK")
    if _is_deep_colour(image):
        import cv2  # imported here, since most images have 8 bits

        with open_binary(path, "an image file") as file:
            deep = cv2.imdecode(np.frombuffer(file.read(), np.uint8), cv2.IMREAD_UNCHANGED)
        if deep is None or deep.ndim != 3 or deep.shape[2] not in (3, 4):
            raise InputError(
                "not readable as an image with 16 bits per channel", where=path, expected="a complete image file"
            )
        colours = cv2.cvtColor(deep, cv2.COLOR_BGR2RGB if deep.shape[2] == 3 else cv2.COLOR_BGRA2RGBA)
        # A fourth band of a TIFF file is alpha only if it is said to be (ExtraSamples), not infrared for example.
        extra = getattr(image, "tag_v2", {338: (2,)}).get(338) or (0,)
        return colours if extra[0] in (1, 2) else colours[..., :3]
    if image.mode in ("P", "PA", *CONVERTED):
        image = image.convert("RGBA" if image.has_transparency_data else "RGB")
    pixels = np.array(image.convert("RGB") if image.mode == "RGBX" else image)
    # Pillow before 11.3 decodes a 16-bit PNG to 32 bits. Other images of 32 bits are stored that way, and are rejected later.
    return pixels.astype(np.uint16) if image.format == "PNG" and pixels.dtype == np.int32 else pixels


@contextlib.contextmanager
def open_image(path: ImageSource) -> Iterator[Image.Image]:
    """Open an image file; its pixels are decoded on first use, within the context.

    Raises ``InputError`` if there is no such regular file, if it is not readable as an image, and if the
    image has more than ``LARGEST_IMAGE`` pixels according to its header, before memory is allocated.
    """
    raw = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
    if isinstance(path, Path) and path.suffix.lower() in raw:
        raise InputError(
            "is a raw photo, of which only a thumbnail would be read",
            where=path,
            expected="a JPEG, PNG or TIFF file developed from it",
        )
    with open_binary(path, "an image file") as file:
        if is_heif(file.read(12)):
            heif = import_extra("pillow_heif", "heif", "reading HEIC", path, "; or convert the photo to JPEG")
            heif.register_heif_opener()
        file.seek(0)
        _check_segments(path, file)
        Image.preinit()
        with contextlib.suppress(ImportError):  # Pillow has it from 11.3 on
            from PIL import AvifImagePlugin  # noqa: F401
        try:
            with Image.open(file, formats=[name for name in FORMATS if name in Image.OPEN]) as image:
                if image.width * image.height > LARGEST_IMAGE:  # whatever limit a program set in Pillow
                    raise Image.DecompressionBombError(f"{image.width * image.height} pixels")
                yield image
        except InputError:
            raise
        except Image.DecompressionBombError as error:
            raise InputError(
                f"image has {' '.join(re.findall(r'[0-9]+ pixels', str(error))[:1])}",
                where=path,
                expected=f"at most {LARGEST_IMAGE // 10**6} megapixels; scale it down",
            ) from error
        except Exception as error:  # decoders may raise anything, even SyntaxError
            why = reason(error)
            if isinstance(error, UnidentifiedImageError):  # its text has the repr of the open file
                file.seek(0)
                is_tiff = file.read(4) in (b"II*\0", b"MM\0*")
                why = f"its content is in none of the formats {', '.join(FORMATS)}"
                why = "a TIFF file whose bands are not those of grey or colour images" if is_tiff else why
            if file.seek(0, os.SEEK_END) == 0:
                why = "the file is empty"
            raise InputError(
                f"not readable as an image ({why})", where=path, expected="a complete image file"
            ) from error


def _check_segments(path: ImageSource, file: BinaryIO) -> None:
    """Raise ``InputError`` for a JPEG file that would take far longer to decode than its size suggests; rewind the file."""
    content = file.read() if file.read(2) == b"\xff\xd8" else b""
    file.seek(0)
    # Each scan goes through the whole image, and libjpeg's usual script has ten of them. The depth map that a phone stores with a
    # photo takes a few hundred segments.
    at, scans, segments, most_scans, most_segments = 0, 0, 0, 100, 1000
    # Within a scan, 0xff is followed by 0 or a restart marker.
    begins = re.compile(rb"\xff([\xc0-\xcf\xd8-\xfe])")
    while marker := begins.search(content, at):
        code, segments = marker[1], segments + 1
        scans += code == b"\xda"
        if code == b"\xd9":  # the end of the image, after which phones store videos
            return
        if scans > most_scans or segments > most_segments:
            raise InputError(
                f"has more than {most_scans} scans or {most_segments} segments",
                where=path,
                expected="a JPEG file of fewer",
            )
        length = content[marker.end() : marker.end() + 2]
        at = marker.end() + (0 if code == b"\xd8" else max(2, int.from_bytes(length, "big")))


def is_heif(head: bytes) -> bool:
    """Return whether the first 12 bytes of a file, or more, identify it as HEIF, such as an iPhone's HEIC, whatever its name."""
    # ISO/IEC 23008-12
    return re.match(rb"(?s)....ftyp(hei[cxms]|hev[cxms]|mif1|msf1)", head) is not None


def looks_like_image(path: Path) -> bool:
    """Return whether the first bytes of a file identify it as an image; nothing is decoded."""
    head = b""
    with contextlib.suppress(InputError), open_binary(path, "an image file") as file:
        head = file.read(12)
    first = rb"(?s)\x89PNG\r\n|\xff\xd8\xff|II\*\0|MM\0\*|GIF8|RIFF....WEBP|BM....\0\0\0\0|....ftypavi[fs]"
    return re.match(first, head) is not None or is_heif(head)


def png_bytes(pixels: Shaped[np.ndarray, "h w *channels"]) -> bytes:
    """Encode an 8-bit image, or a 16-bit grey one, as the content of a PNG file."""
    import imageio.v3 as iio  # imported here, since reading does not need it

    return bytes(iio.imwrite("<bytes>", pixels, extension=".png"))
