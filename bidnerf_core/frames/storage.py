"""Storage for the images of many frames, from which pixels of many images are read at once.

The images are stored in a few large blocks of memory or, if there are many images, in mapped files.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.frames.frame import Frame, as_floats

FILE_BLOCK = 2**28
"""Bytes per block, unless an image is larger. If there are only a few blocks, drawing pixels from all images at once is cheap.
Images that need more than one block are held in files, whose pages the system may drop when it needs memory."""
ALIGNMENT = 16
MOST_BLOCKS = 64
"""Number of separate blocks of memory above which images are copied into one."""


class PixelStore:
    """Stores the images of frames one after another.

    ``expected`` is the number of bytes that will be stored. If it exceeds ``BLOCK``, the images go to unnamed
    files in ``folder`` (by default, the system's folder for temporary files) that vanish with the process.
    """

    def __init__(self, expected: int, folder: Path | None = None) -> None:
        self._mapped, self._folder, self._expected = expected > FILE_BLOCK, folder, expected
        self._block, self._used = torch.empty(0, dtype=torch.uint8), 0

    def store(self, frame: Frame) -> Frame:
        """Return the frame with its images in the store."""
        images = {
            name: None if image is None else self.copy(image if name == "hidden" else image.float())
            for name, image in (("depth", frame.depth), ("alpha", frame.alpha), ("hidden", frame.hidden))
        }
        return frame.replace(rgb=self.copy(frame.rgb_bytes), **images)

    def copy(self, image: Shaped[Tensor, "*n"]) -> Shaped[Tensor, "*n"]:
        """Copy an image into the store and return the copy."""
        size = image.numel() * image.element_size()
        start = -(-self._used // ALIGNMENT) * ALIGNMENT
        if start + size > len(self._block):
            self._block, start = self._new_block(size), 0
        self._used = start + size
        return self._block[start : start + size].view(image.dtype).view(image.shape).copy_(image)

    def _new_block(self, least: int) -> Tensor:
        size = max(least, min(FILE_BLOCK, self._expected + ALIGNMENT))
        if not self._mapped:
            return torch.empty(size, dtype=torch.uint8)
        try:
            with tempfile.TemporaryFile(dir=self._folder) as file:
                # Writing to a mapped page for which the disk has no room would end the process.
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, size)
                else:
                    os.truncate(file.fileno(), size)
                return torch.from_numpy(np.memmap(file, np.uint8, "r+", shape=(size,)))
        except OSError as error:
            raise InputError(
                f"no room for {self._expected / 1e6:.0f} MB of images ({error.strerror or error}), free that"
                " much, or read them smaller (`largest`)",
                where=self._folder or tempfile.gettempdir(),
            ) from error


def bytes_of(frame: Frame) -> int:
    """Return the number of bytes that a store needs for the images of a frame."""
    images = ((frame.rgb_bytes, 1), (frame.depth, 4), (frame.alpha, 4), (frame.hidden, 1))
    return sum(image.numel() * size for image, size in images if image is not None)


@dataclass(frozen=True, eq=False)
class ImagePixels:
    """The pixels of images with the same number of channels; pixels of an image are numbered row by row."""

    blocks: Sequence[Shaped[Tensor, "_"]]  # flat; all values of a block have the same type
    block: Int[Tensor, "v"]  # index of the block that holds each image; -1 if there is no image
    start: Int[Tensor, "v"]  # index of the image's first value in that block
    channels: int
    default: float = 0.0  # the value of missing images

    @staticmethod
    def of(
        images: Sequence[Tensor | None],
        channels: int,
        default: float = 0.0,
        device: torch.device | str = "cpu",
    ) -> ImagePixels:
        """Store ``images`` on ``device``; for an image that is None, every pixel has the value ``default``.

        On the CPU, images that share a few blocks of memory are not copied.
        """
        device, present = torch.device(device), {i: x.detach() for i, x in enumerate(images) if x is not None}
        block, start = torch.tensor([[-1], [0]]).repeat(1, len(images))
        if device.type != "cpu":  # one block for each type
            flat = []
            for number, kind in enumerate({image.dtype for image in present.values()}):
                own = {i: image for i, image in present.items() if image.dtype == kind}
                flat.append(torch.empty(sum(map(Tensor.numel, own.values())), dtype=kind, device=device))
                first = 0
                for i, image in own.items():
                    flat[number][first : first + image.numel()].copy_(image.reshape(-1))
                    block[i], start[i], first = number, first, first + image.numel()
            return ImagePixels(flat, block.to(device), start.to(device), channels, default)
        present = {i: image.cpu().contiguous() for i, image in present.items()}
        if len({_block(image) for image in present.values()}) > MOST_BLOCKS:
            store = PixelStore(sum(image.nbytes + ALIGNMENT for image in present.values()))
            present = {i: store.copy(image) for i, image in present.items()}
        blocks = {_block(image): image for image in present.values()}
        numbers = {key: number for number, key in enumerate(blocks)}
        for i, image in present.items():
            block[i], start[i] = numbers[_block(image)], image.storage_offset()
        flat = [torch.empty(0, dtype=image.dtype).set_(image.untyped_storage()) for image in blocks.values()]
        return ImagePixels(flat, block, start, channels, default)

    def at(self, image: Int[Tensor, "p"], pixel: Int[Tensor, "p"]) -> Float[Tensor, "p c"]:
        """Return the values of ``pixel[i]`` in ``image[i]`` for each i; bytes become floats in [0, 1]."""
        block = self.block[image][:, None]
        first = self.start[image] + pixel * self.channels
        index = first[:, None] + torch.arange(self.channels, device=first.device)
        values = torch.full(index.shape, self.default, device=first.device)
        for number, flat in enumerate(self.blocks):
            own = block == number
            values = torch.where(own, as_floats(flat[torch.where(own, index, 0)]).float(), values)
        return values


def _block(image: Tensor) -> tuple[int, torch.dtype]:
    return image.untyped_storage().data_ptr(), image.dtype
