"""Where pixels are drawn: anywhere, at corners, or around corners."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Int
from kornia.color import rgb_to_grayscale
from kornia.feature import gftt_response
from kornia.geometry.subpix import nms2d
from torch import Tensor
from torch.nn.functional import max_pool2d

from bidnerf_core.frames import Frame, PixelDrawer, among, uniform

DrawerName = Literal["uniform", "interest-points", "interest-regions"]


def interest_points(frame: Frame) -> Int[Tensor, "n 2"]:
    """Return the corners (column, row) of a frame (Shi and Tomasi 1994, "Good features to track"), possibly none."""
    if min(frame.rgb_bytes.shape[:2]) <= 3:  # no larger than the margin that the detector needs
        return torch.zeros((0, 2), dtype=torch.long)
    grey = rgb_to_grayscale(frame.rgb.detach().float().cpu().permute(2, 0, 1)[None])
    response = nms2d(gftt_response(grey), (5, 5))[0, 0]
    # Corners are at least a hundredth as strong as the strongest. A blank wall with noise of 1/255 stays below 1e-5.
    return (response > max(0.01 * float(response.max()), 1e-5)).nonzero().flip(-1)


def interest_regions(frame: Frame) -> Int[Tensor, "n 2"]:
    """Return the interest points of a frame and the pixels up to six away from them along both axes, row by row."""
    columns, rows = interest_points(frame).unbind(-1)
    mask = torch.zeros((1, *frame.rgb_bytes.shape[:2]))
    mask[0, rows, columns] = 1
    return max_pool2d(mask, 13, stride=1, padding=6)[0].nonzero().flip(-1)


DRAWERS: dict[DrawerName, PixelDrawer] = {
    "uniform": uniform,
    "interest-points": among(interest_points),
    "interest-regions": among(interest_regions),
}
"""The ways to draw pixels, by name."""
