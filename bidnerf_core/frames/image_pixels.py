"""Pixel values of many images at once, wherever in memory the images are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from bidnerf_core.frames.colours import as_floats

MOST_BLOCKS = 64
"""Number of separate blocks of memory above which images are copied into one."""


@dataclass(frozen=True, eq=False)
class ImagePixels:
    """The pixels of images with the same number of channels; pixels of an image are numbered row by row."""

    blocks: Sequence[Shaped[Tensor, "_"]]  # each flat; of one type within a block
    block: Int[Tensor, "v"]  # index of the block that holds each image; -1 if there is no image
    start: Int[Tensor, "v"]  # index of its first value in that block
    channels: int
    default: float = 0.0  # the value of missing images

    @staticmethod
    def of(images: Sequence[Tensor | None], channels: int, default: float = 0.0) -> ImagePixels:
        """Build this from ``images``; None has the value ``default`` everywhere. Images that share few blocks
        of memory are not copied.
        """
        present = [image.detach().cpu().contiguous() for image in images if image is not None]
        if len({_block(image) for image in present}) > MOST_BLOCKS:
            present = _together(present)
        numbers: dict[tuple[int, torch.dtype], int] = {}
        blocks: list[Tensor] = []
        for image in present:
            if _block(image) not in numbers:
                numbers[_block(image)] = len(blocks)
                blocks.append(torch.empty(0, dtype=image.dtype).set_(image.untyped_storage()))
        found = iter(present)
        pairs = [_place(next(found), numbers) if image is not None else (-1, 0) for image in images]
        block, start = torch.tensor(pairs, dtype=torch.long).reshape(-1, 2).unbind(-1)
        return ImagePixels(blocks, block, start, channels, default)

    def at(self, image: Int[Tensor, "p"], pixel: Int[Tensor, "p"]) -> Float[Tensor, "p c"]:
        """Return the values of pixels, each from the image with that index; bytes become floats in [0, 1]."""
        block = self.block[image]
        first = self.start[image] + pixel * self.channels
        index = first[:, None] + torch.arange(self.channels)
        if len(self.blocks) == 1 and bool((block == 0).all()):
            return as_floats(self.blocks[0][index])
        values = torch.full(index.shape, self.default)
        for number in block.unique().tolist():
            if number >= 0:
                own = block == number
                values[own] = as_floats(self.blocks[number][index[own]]).float()
        return values


def _block(image: Tensor) -> tuple[int, torch.dtype]:
    return image.untyped_storage().data_ptr(), image.dtype


def _place(image: Tensor, numbers: dict[tuple[int, torch.dtype], int]) -> tuple[int, int]:
    return numbers[_block(image)], int(image.storage_offset())


def _together(images: Sequence[Tensor]) -> list[Tensor]:
    """Copy images into one block, of bytes if all are bytes, else of floats."""
    kind = torch.uint8 if all(image.dtype == torch.uint8 for image in images) else torch.float32
    whole = torch.empty(sum(image.numel() for image in images), dtype=kind)
    found, first = [], 0
    for image in images:
        part = whole[first : first + image.numel()].view(image.shape)
        found.append(part.copy_(image if image.dtype == kind else as_floats(image)))
        first += image.numel()
    return found
