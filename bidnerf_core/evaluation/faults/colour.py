"""Faults of exposure, optics and compression. They act on the stored values, which are in [0, 1]."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from kornia.color import rgb_to_grayscale
from kornia.filters import gaussian_blur2d
from PIL import Image
from torch import Generator, Tensor

from bidnerf_core.frames import Frame


def recoloured(frame: Frame, rgb: Float[Tensor, "h w 3"]) -> Frame:
    """Return the frame with other colours; values brighter than white are clipped."""
    return replace(frame, rgb=rgb.clamp(0, 1))


def blur(frame: Frame, pixels: float, generator: Generator) -> Frame:
    """Blur the colours with a Gaussian whose standard deviation is ``pixels``. Depth stays sharp."""
    smallest = min(frame.rgb.shape[:2])
    # Padding by reflection at the border cannot be wider than the image.
    size = min(2 * max(1, round(3 * pixels)) + 1, smallest - 1 + smallest % 2)
    images = frame.rgb.permute(2, 0, 1)[None]
    return recoloured(frame, gaussian_blur2d(images, (size, size), (pixels, pixels))[0].permute(1, 2, 0))


def jpeg(frame: Frame, quality: float, generator: Generator) -> Frame:
    """Compress the colours as JPEG of ``quality`` 1 to 100, and decode them."""
    file = io.BytesIO()
    Image.fromarray((frame.rgb * 255).round().to(torch.uint8).numpy()).save(
        file, "JPEG", quality=int(quality)
    )
    return recoloured(frame, torch.from_numpy(np.array(Image.open(file))).to(frame.rgb) / 255)


def grey(frame: Frame, share: float, generator: Generator) -> Frame:
    """Remove ``share`` of the colours' saturation: 1 leaves only their brightness."""
    brightness = rgb_to_grayscale(frame.rgb.permute(2, 0, 1)).permute(1, 2, 0)
    return recoloured(frame, frame.rgb + share * (brightness - frame.rgb))


def vignetting(frame: Frame, share: float, generator: Generator) -> Frame:
    """Darken the image with the square of the distance from its centre, the corners by ``share``."""
    camera = frame.intrinsics
    middle = frame.rgb.new_tensor([camera.width / 2, camera.height / 2])
    radius = (camera.pixel_centres() - middle).norm(dim=-1, keepdim=True) / middle.norm()
    return recoloured(frame, frame.rgb * (1 - share * radius.square()))
