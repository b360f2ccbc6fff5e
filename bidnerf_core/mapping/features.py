"""Keypoints of an image: where they are, and descriptors by which they are found again in another image.

A ``Features`` is the seam: any detector, a learned one included, that turns an image into ``Keypoints``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from bidnerf_core.errors import InputError

NORM = 512.0
"""Length of a quantised descriptor (Lowe 2004, section 6.1, scales SIFT so, which uses the range of a byte well)."""
FIRST_CENTRE = 0.5
"""OpenCV puts the centre of the first pixel at (0, 0), we put it at (0.5, 0.5)."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one image. Descriptors are compared by Euclidean distance."""

    pixels: Float[Tensor, "n 2"]  # (u, v), the centre of the first pixel at (0.5, 0.5)
    sizes: Float[Tensor, "n"]  # pixels: diameter of the region that the descriptor describes the middle of
    descriptors: UInt8[Tensor, "n d"]

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, index: Tensor) -> Keypoints:
        return Keypoints(self.pixels[index], self.sizes[index], self.descriptors[index])


@runtime_checkable
class Features(Protocol):
    """Detects and describes keypoints; the number of a descriptor's channels is always the same.

    It must be callable from several threads at once. ``quantized`` turns float descriptors into bytes.
    """

    def __call__(self, rgb: Float[Tensor, "h w 3"]) -> Keypoints: ...


@dataclass(frozen=True)
class Sift:
    """SIFT (Lowe 2004) by OpenCV, with the root normalisation of Arandjelovic and Zisserman 2012."""

    count: int = 2000  # keypoints, at most: those of highest contrast
    contrast: float = (
        0.01  # under which an extremum is no keypoint; OpenCV's default of 0.04 leaves few indoors
    )

    # Pixels along the longer side above which an image is reduced first: a phone's twelve megapixels hold no more
    # keypoints of the sizes that maps are made of, and take half a minute.
    largest: int = 800

    def __post_init__(self) -> None:
        if self.largest < 16:
            raise InputError(f"largest side of an image is {self.largest} pixels, expected at least 16")
        if self.count < 1:
            raise InputError(f"count of keypoints is {self.count}, expected at least 1")
        if not 0 <= self.contrast < 1:
            raise InputError(f"contrast of keypoints is {self.contrast}, expected 0 to 1")

    def __call__(self, rgb: Float[Tensor, "h w 3"]) -> Keypoints:
        # The precise upscaling maps index x to 2 x: without it all keypoints of the first octave are a quarter of a
        # pixel off. A detector object is not safe to share between threads, and costs nothing to make.
        sift = cv2.SIFT.create(
            nfeatures=self.count, contrastThreshold=self.contrast, enable_precise_upscale=True
        )
        grey, scale = _reduced(_grey(rgb), self.largest)
        found, descriptors = sift.detectAndCompute(grey, None)
        if descriptors is None or not len(found):
            return Keypoints(torch.zeros(0, 2), torch.zeros(0), torch.zeros((0, 128), dtype=torch.uint8))
        pixels = (np.asarray(cv2.KeyPoint.convert(found), dtype=np.float32) + FIRST_CENTRE) / scale
        sizes = np.array([keypoint.size for keypoint in found], dtype=np.float32) / scale.mean()
        root = root_normalized(torch.from_numpy(np.asarray(descriptors, dtype=np.float32)))
        return Keypoints(torch.from_numpy(pixels), torch.from_numpy(sizes), quantized(root))


def root_normalized(descriptors: Float[Tensor, "n d"]) -> Float[Tensor, "n d"]:
    """Square roots of the shares of each non-negative channel; of unit length, and Euclidean distance is Hellinger's."""
    total = descriptors.sum(-1, keepdim=True).clamp(min=torch.finfo(descriptors.dtype).tiny)
    return (descriptors / total).sqrt()


def quantized(descriptors: Float[Tensor, "n d"]) -> UInt8[Tensor, "n d"]:
    """Descriptors of unit length as bytes; those with negative channels are shifted, which keeps distances."""
    negative = len(descriptors) > 0 and float(descriptors.min()) < 0
    scaled = descriptors * (NORM / 2 if negative else NORM) + (128 if negative else 0)
    return scaled.round().clamp(0, 255).to(torch.uint8)


def squared_distances(
    a: UInt8[Tensor, "n d"] | Float[Tensor, "n d"], b: UInt8[Tensor, "m d"] | Float[Tensor, "m d"]
) -> Float[Tensor, "n m"]:
    """Squared Euclidean distances between all pairs; exact for bytes, whose sums of squares a float32 holds."""
    x, y = a.float(), b.float()
    return torch.addmm((x * x).sum(-1)[:, None] + (y * y).sum(-1), x, y.T, alpha=-2).clamp_(min=0)


def paired_squared_distances(
    a: UInt8[Tensor, "n d"],
    b: UInt8[Tensor, "m d"],
    rows: Int[Tensor, "p"],
    columns: Int[Tensor, "p"],
) -> Float[Tensor, "p"]:
    """Squared Euclidean distances of the pairs ``a[rows]`` and ``b[columns]`` alone."""
    return (a[rows].float() - b[columns].float()).square_().sum(-1)


def _grey(rgb: Float[Tensor, "h w 3"]) -> np.ndarray:
    clean = rgb.detach().cpu().float().nan_to_num(0.0).clamp(0, 1)
    return cv2.cvtColor((clean * 255).round().to(torch.uint8).contiguous().numpy(), cv2.COLOR_RGB2GRAY)


def _reduced(grey: np.ndarray, largest: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the image with at most ``largest`` pixels along its longer side, and its scale (x, y)."""
    height, width = grey.shape
    factor = largest / max(height, width)
    if factor >= 1:
        return grey, np.ones(2, dtype=np.float32)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    scale = np.array([size[0] / width, size[1] / height], dtype=np.float32)
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA), scale
