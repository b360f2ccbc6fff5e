"""Resampling of images at other positions in the image plane."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.frames import Frame


def warped(frame: Frame, pixels: Float[Tensor, "h w 2"]) -> Frame:
    """Return the frame whose pixel (v, u) shows what ``frame`` shows at ``pixels[v, u]``, given as (u, v).

    Colour and alpha are interpolated, with border values replicated beyond the border. Depth is that of the
    nearest pixel, since a mean across an edge lies on neither surface; it is 0 beyond the border.
    """
    alpha = None if frame.alpha is None else _interpolated(frame.alpha[..., None], pixels)[..., 0]
    depth = None if frame.depth is None else nearest(frame.depth, pixels)
    hidden = None if frame.hidden is None else nearest(frame.hidden.float(), pixels) > 0
    rgb = _interpolated(frame.rgb, pixels).clamp(0, 1)
    return replace(frame, rgb=rgb, alpha=alpha, depth=depth, hidden=hidden)


def reflected(pixels: Float[Tensor, "*p 2"], width: int, height: int) -> Float[Tensor, "*p 2"]:
    """Return pixels (u, v) inside an image: those beyond a border are reflected at it."""
    size = pixels.new_tensor([width, height])
    folded = pixels.remainder(2 * size)
    return torch.minimum(folded, 2 * size - folded)


def nearest(image: Float[Tensor, "h w"], pixels: Float[Tensor, "*p 2"]) -> Float[Tensor, "*p"]:
    """Return the values of the pixels that contain the positions ``pixels``, and 0 beyond the border."""
    height, width = image.shape
    column, row = pixels.floor().long().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    values = image[row.clamp(0, height - 1), column.clamp(0, width - 1)]
    return torch.where(inside, values, torch.zeros_like(values))


def _interpolated(image: Float[Tensor, "h w c"], pixels: Float[Tensor, "h w 2"]) -> Float[Tensor, "h w c"]:
    height, width = image.shape[:2]
    size = torch.tensor([width, height], dtype=torch.float64)
    grid = (pixels.double() * 2 / size - 1).to(image.dtype)
    moved = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None], grid[None], mode="bilinear", padding_mode="border", align_corners=False
    )
    return moved[0].permute(1, 2, 0)
