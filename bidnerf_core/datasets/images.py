"""Image files as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError

FULL_SCALE = {"bool": 1, "uint8": 255, "uint16": 65535}


def read_image(path: Path) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"] | None]:
    """Colour in [0, 1], not yet laid over anything, and alpha where there is a channel of it; grey becomes three channels.

    Raises ``InputError`` where the file is not a whole image of 1 to 4 channels of 8 bit (or 16 bit grey).
    """
    raw = _decoded(path)
    channels = raw.shape[2] if raw.ndim == 3 else 1
    if raw.ndim not in (2, 3) or channels > 4 or raw.dtype.name not in FULL_SCALE:
        found = f"{'x'.join(map(str, raw.shape))} of {raw.dtype.name}"
        raise InputError(f"{path}: image decodes to {found}, expected grey, RGB or RGBA of 8 bit")
    scaled = raw.reshape(*raw.shape[:2], channels).astype(np.float32) / FULL_SCALE[raw.dtype.name]
    values = torch.from_numpy(scaled)
    alpha = values[..., -1].clone() if channels in (2, 4) else None
    colour = values[..., : channels - 1] if alpha is not None else values
    return colour.expand(*colour.shape[:2], 3).contiguous(), alpha


def read_depth(path: Path, unit: float) -> Float[Tensor, "h w"]:
    """Planar z in metres, ``unit`` metres a step; 0 where nothing, or nothing finite and positive, was measured.

    Takes a grey image of whole numbers or the ``.npy`` of an array. Raises ``InputError`` for anything else.
    """
    raw = _loaded(path) if path.suffix.lower() == ".npy" else _decoded(path)
    raw = raw[..., 0] if raw.ndim == 3 and raw.shape[2] == 1 else raw
    if raw.ndim != 2 or raw.dtype.kind not in "uif":
        found = f"{'x'.join(map(str, raw.shape))} of {raw.dtype.name}"
        raise InputError(f"{path}: depth is {found}, expected one channel of whole or floating-point numbers")
    metres = raw.astype(np.float64) * unit
    return torch.from_numpy(np.where(np.isfinite(metres) & (metres > 0), metres, 0).astype(np.float32))


def over(
    colour: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"] | None, background: Sequence[float]
) -> Float[Tensor, "h w 3"]:
    """Straight (not premultiplied) colour laid over ``background``."""
    if alpha is None:
        return colour
    cover = alpha[..., None]
    return colour * cover + colour.new_tensor(background) * (1 - cover)


def _decoded(path: Path) -> np.ndarray:
    try:
        with iio.imopen(path, "r", plugin="pillow") as file:
            image = file.read(index=0)
            mode = file.metadata(index=0, exclude_applied=False).get("mode", "")
    except Exception as error:  # decoders raise whatever they like, SyntaxError included
        raise InputError(
            f"{path}: not readable as an image ({_reason(error)}), expected a whole image file"
        ) from error
    if mode in ("CMYK", "YCbCr", "LAB", "HSV"):
        raise InputError(f"{path}: image is {mode}, expected grey, RGB or RGBA")
    return np.asarray(image)


def _loaded(path: Path) -> np.ndarray:
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError) as error:
        raise InputError(
            f"{path}: not readable as an array ({_reason(error)}), expected a .npy file"
        ) from error


def _reason(error: Exception) -> str:
    """The first line of what a decoder says, which may be many."""
    text = str(error).strip()
    return text.splitlines()[0][:120] if text else type(error).__name__
