"""Random blobs and textures, of which occluders are made."""

from __future__ import annotations

import math

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from bidnerf_core.evaluation.faults.fault import uniform_number

WAVES = (2, 3, 4, 5)
"""Numbers of periods around a blob's outline of the waves that compose its radius."""
BULGE = 0.35
"""Maximum amplitude of each wave, in the logarithm of the radius."""
BLOB_OCTAVES = (4, 8, 16, 32, 64, 128)
"""Numbers of cells along the longer side, for the octaves of noise whose sum is a texture."""


def blob(height: int, width: int, share: float, generator: Generator) -> Bool[Tensor, "h w"]:
    """Return a mask of one irregular piece around a random place, which covers exactly ``share`` of the image.

    With the same state of the generator, a larger share covers all that a smaller one does.
    """
    centre = uniform_number(generator, 0.2, 0.8) * width, uniform_number(generator, 0.2, 0.8) * height
    down = torch.arange(height, dtype=torch.float32)[:, None] + 0.5 - centre[1]
    across = torch.arange(width, dtype=torch.float32)[None, :] + 0.5 - centre[0]
    distance = torch.hypot(down, across) / _radius(torch.atan2(down, across), generator)
    covered = round(share * height * width)
    mask = torch.zeros(height * width, dtype=torch.bool)
    mask[distance.flatten().argsort()[:covered]] = True
    return mask.reshape(height, width)


def _radius(angle: Float[Tensor, "h w"], generator: Generator) -> Float[Tensor, "h w"]:
    """Return the radius of an irregular outline at ``angle`` (radians) around its centre.

    Every point of the outline is visible from the centre, so that the blob is one piece.
    """
    waves = [
        uniform_number(generator, -BULGE, BULGE)
        * torch.cos(n * angle + uniform_number(generator, 0, 2 * math.pi))
        for n in WAVES
    ]
    return torch.stack(waves).sum(0).exp()


def texture(height: int, width: int, generator: Generator) -> Float[Tensor, "h w 3"]:
    """Return random colours with detail at several scales and full contrast, with as many features as a photo."""
    longer = max(height, width)
    layers = [
        torch.stack([smooth_noise(height, width, *_cells(height, width, n, longer), generator) for _ in range(3)], -1)
        * (BLOB_OCTAVES[0] / n) ** 0.5
        for n in BLOB_OCTAVES
    ]  # fmt: skip
    noise = torch.stack(layers).sum(0)
    low, high = noise.flatten(0, 1).quantile(torch.tensor([0.02, 0.98]), dim=0)
    return ((noise - low) / (high - low).clamp_min(1e-6)).clamp(0, 1)


def smooth_noise(
    height: int, width: int, rows: int, columns: int, generator: Generator
) -> Float[Tensor, "h w"]:
    """Return normally distributed values on a grid of ``rows`` by ``columns``, interpolated with cubic splines."""
    values = torch.randn((1, 1, rows, columns), generator=generator)
    return torch.nn.functional.interpolate(values, (height, width), mode="bicubic", align_corners=False)[0, 0]


def _cells(height: int, width: int, count: int, longer: int) -> tuple[int, int]:
    return max(2, round(count * height / longer)), max(2, round(count * width / longer))
