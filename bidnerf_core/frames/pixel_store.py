"""Storage for the images of many frames: bytes in a few large blocks of memory or, if there are many, in a
mapped file.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames.colours import are_bytes, as_bytes
from bidnerf_core.frames.frame import Frame

BLOCK = 2**28
"""Bytes per block, unless an image is larger. With few blocks it is cheap to draw pixels from all images at once."""
IN_MEMORY = 2**28
"""Bytes of images held in memory; more are held in a file, whose pages the system may drop when it needs memory."""
ALIGNMENT = 16


class PixelStore:
    """Holds the images of frames one after another.

    ``expected`` is the number of bytes that will be stored. If it exceeds ``IN_MEMORY``, they go to nameless
    files in ``folder`` (by default, the system's folder for temporary files) that vanish with the process.
    """

    def __init__(self, expected: int, folder: Path | None = None) -> None:
        self._mapped, self._folder, self._expected = expected > IN_MEMORY, folder, expected
        self._block, self._used = torch.empty(0, dtype=torch.uint8), 0

    def stored(self, frame: Frame) -> Frame:
        """Return the frame with its images in the store. Colours exactly representable as bytes become bytes."""
        rgb = frame.held_rgb.cpu()
        if rgb.dtype != torch.uint8 and are_bytes(rgb):
            rgb = as_bytes(rgb)
        depth, alpha = (None if part is None else part.float().cpu() for part in (frame.depth, frame.alpha))
        images: dict[str, Any] = {
            name: self._placed(part)
            for name, part in (("depth", depth), ("alpha", alpha), ("hidden", frame.hidden))
            if part is not None
        }
        return replace(frame, rgb=self._placed(rgb), **images)

    def _placed(self, image: Shaped[Tensor, "*n"]) -> Shaped[Tensor, "*n"]:
        size = image.numel() * image.element_size()
        start = -(-self._used // ALIGNMENT) * ALIGNMENT
        if start + size > len(self._block):
            self._block, start = self._new_block(size), 0
        self._used = start + size
        found = self._block[start : start + size].view(image.dtype).view(image.shape)
        return found.copy_(image)

    def _new_block(self, least: int) -> Tensor:
        size = max(least, min(BLOCK, self._expected + ALIGNMENT))
        if not self._mapped:
            return torch.empty(size, dtype=torch.uint8)
        try:
            with tempfile.TemporaryFile(dir=self._folder) as file:
                _reserve(file.fileno(), size)
                return torch.from_numpy(np.memmap(file, np.uint8, "r+", shape=(size,)))
        except OSError as error:
            place = self._folder or tempfile.gettempdir()
            raise InputError(
                f"no room for {self._expected / 1e6:.0f} MB of images ({error.strerror or error}), free that"
                " much, or read them smaller (--largest, largest=)",
                where=place,
            ) from error


def _reserve(file: int, size: int) -> None:
    """Allocate disk space for a file: writing to a mapped page for which the disk has no room would end the process."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.truncate(file, size)


def bytes_of(frame: Frame) -> int:
    """Return the number of bytes that a store needs for the images of a frame."""
    composited = frame.alpha is not None and frame.held_rgb.dtype != torch.uint8  # no longer bytes
    return sum(
        part.numel() * size
        for part, size in (
            (frame.held_rgb, 4 if composited else 1), (frame.depth, 4), (frame.alpha, 4), (frame.hidden, 1),
        )
        if part is not None
    )  # fmt: skip
