"""The box of the visual hull: the space consistent with silhouettes seen from many sides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.carving.cells import occupied_cells
from bidnerf_core.fields import crossed_box
from bidnerf_core.frames import View

AxisBox: TypeAlias = tuple[Float[Tensor, "3"], Float[Tensor, "3"]]
"""Lower and upper corner: metres, world, float64."""


def grown(
    lower: Float[Tensor, "3"], upper: Float[Tensor, "3"], at_least: float = 0.0, share: float = 0.03
) -> AxisBox:
    """Return the box with a margin of ``share`` of its size at each end, or of ``at_least`` metres if that is more.

    A flat box is given some thickness.
    """
    size = upper - lower
    margin = torch.maximum(size * share, size.amax() * 0.01).clamp(min=at_least)
    return lower - margin, upper + margin


def rays_of(
    view: View, wanted: Bool[Tensor, "h w"], share: int
) -> tuple[Float[Tensor, "n 3"], tuple[Int[Tensor, "n"], Int[Tensor, "n"]]]:
    """Return about ``share`` of the wanted pixels, evenly spread: points at z = 1 (camera frame), rows and columns."""
    rows, columns = wanted.nonzero(as_tuple=True)
    stride = max(1, len(rows) // share)
    rows, columns = rows[::stride], columns[::stride]
    ray = view.frame.intrinsics.unproject(torch.stack([columns, rows], dim=-1).double() + 0.5)
    return ray, (rows, columns)


def has_outline(view: View) -> bool:
    """Return whether the image shows background; alpha that is 1 everywhere carries no information."""
    frame = view.frame
    return frame.alpha is not None and bool(
        (frame.alpha if frame.hidden is None else frame.alpha[~frame.hidden]).amin() <= 0
    )


def carved_box(box: AxisBox, views: Sequence[View]) -> AxisBox:
    """Return the box of the cells that no two views see through and at which many views see something.

    The threshold on that number, relative to the largest of any cell, is the largest for which the box still meets 99.9 % of
    the rays to pixels with matter: so few views see peripheral cells that hardly any could have emptied them. Each of three
    rounds carves the box that the previous one found.
    """
    side = 64
    origins, directions = _rays_to_matter(views)
    for _ in range(3):
        lower, upper = box
        cell = (upper - lower) / side
        kept = occupied_cells(views, lower.tolist(), upper.tolist(), (side,) * 3).nonzero()
        if len(kept) == 0:
            return box
        points = lower + (kept + 0.5) * cell
        witnesses = torch.stack([_shows_something(view, points) for view in views]).sum(dim=0)
        for share in (0.5, 0.25, 0.1, 0.0):
            cells = kept[witnesses >= share * witnesses.amax()]
            box = grown(lower + cells.amin(dim=0) * cell, lower + (cells.amax(dim=0) + 1) * cell)
            near, far = crossed_box(origins, directions, *box)
            if (far >= near.clamp(min=0)).double().mean() >= 0.999:
                break
    return box


def _rays_to_matter(views: Sequence[View]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return the origins and directions (world) of rays through a sample of the pixels whose alpha is over a half."""
    origins, directions = [], []
    for view in views:
        alpha, hidden = view.frame.alpha, view.frame.hidden
        assert alpha is not None  # it has an outline
        ray, _ = rays_of(view, alpha > 0.5 if hidden is None else (alpha > 0.5) & ~hidden, 500)
        directions.append(view.T_ref_camera.to(torch.float64).rotate(ray))
        origins.append(view.T_ref_camera.translation.double().expand_as(ray))
    return torch.cat(origins), torch.cat(directions)


def _shows_something(view: View, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    """Return whether a view shows matter (alpha over 0) at each point (metres, world)."""
    camera, alpha, hidden = view.frame.intrinsics, view.frame.alpha, view.frame.hidden
    seen = view.T_ref_camera.to(torch.float64).inverse().apply(points).float()
    row, column, inside = camera.cells(seen)
    inside = inside if hidden is None else inside & ~hidden[row, column]
    return inside if alpha is None else inside & (alpha[row, column] > 0)
