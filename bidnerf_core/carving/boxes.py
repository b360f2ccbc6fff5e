"""Axis-aligned boxes in the world, and rays of a view's pixels."""

from __future__ import annotations

from typing import TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.fields import crossed_box
from bidnerf_core.frames import View

Corner: TypeAlias = tuple[float, float, float]
AxisBox: TypeAlias = tuple[Float[Tensor, "3"], Float[Tensor, "3"]]
"""Lower and upper corner: metres, world, float64."""

MARGIN = 0.03  # of the box's size, at each end


def grown(
    lower: Float[Tensor, "3"], upper: Float[Tensor, "3"], at_least: float = 0.0, share: float = MARGIN
) -> AxisBox:
    """Return the box with a margin of ``share`` of its size at each end, or of ``at_least`` metres if that is
    more.

    A flat box is given some thickness.
    """
    size = upper - lower
    margin = torch.maximum(size * share, size.amax() * 0.01).clamp(min=at_least)
    return lower - margin, upper + margin


def met(box: AxisBox, origins: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> float:
    """Return the fraction of the rays that hit the box."""
    near, far = crossed_box(origins, directions, *box)
    return (far >= near.clamp(min=0)).double().mean().item()


def corner(point: Float[Tensor, "3"]) -> Corner:
    x, y, z = point.tolist()
    return x, y, z


def rays_of(
    view: View, wanted: Bool[Tensor, "h w"], share: int
) -> tuple[Float[Tensor, "n 3"], tuple[Int[Tensor, "n"], Int[Tensor, "n"]]]:
    """Return about ``share`` of the wanted pixels, evenly spread: points at z = 1 (camera frame), rows and columns."""
    rows, columns = wanted.nonzero(as_tuple=True)
    stride = max(1, len(rows) // share)
    rows, columns = rows[::stride], columns[::stride]
    ray = view.frame.intrinsics.unproject(torch.stack([columns, rows], dim=-1).double() + 0.5)
    return ray, (rows, columns)
