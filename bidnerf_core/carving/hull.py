"""The box of the visual hull: the space consistent with silhouettes seen from many sides."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from bidnerf_core.carving.boxes import AxisBox, corner, grown, met, rays_of
from bidnerf_core.carving.cells import occupied_cells
from bidnerf_core.frames import View

HULL = (64, 64, 64)
CARVING_ROUNDS = 3  # each within the box that the previous one found
HULL_VOTES = (0.5, 0.25, 0.1, 0.0)
"""Thresholds on the number of views that see something at a cell, as fractions of the largest such number.
Cells below it are peripheral: so few views see them that hardly any could have emptied them."""
EXPLAINED = 0.999  # fraction of the pixels with matter whose rays must meet the box
RAYS_OF_VIEW = 500


def has_outline(view: View) -> bool:
    """Return whether the image shows background; alpha that is 1 everywhere carries no information."""
    frame = view.frame
    return frame.alpha is not None and bool(
        (frame.alpha if frame.hidden is None else frame.alpha[~frame.hidden]).amin() <= 0
    )


def carved_box(box: AxisBox, views: Sequence[View]) -> AxisBox:
    """Return the box of the cells that no two views see through and at which many views see something.

    The threshold on that number is the largest of ``HULL_VOTES`` for which the box still explains the
    silhouettes.
    """
    origins, directions = _rays_to_matter(views)
    for _ in range(CARVING_ROUNDS):
        lower, upper = box
        cell = (upper - lower) / torch.tensor(HULL)
        kept = occupied_cells(views, corner(lower), corner(upper), HULL).nonzero()
        if len(kept) == 0:
            return box
        witnesses = _votes(views, lower + (kept + 0.5) * cell)
        for share in HULL_VOTES:
            cells = kept[witnesses >= share * witnesses.amax()]
            box = grown(lower + cells.amin(dim=0) * cell, lower + (cells.amax(dim=0) + 1) * cell)
            if met(box, origins, directions) >= EXPLAINED:
                break
    return box


def _rays_to_matter(views: Sequence[View]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Return the origins and directions (world) of rays through a sample of the pixels whose alpha is over a half."""
    origins, directions = [], []
    for view in views:
        alpha, hidden = view.frame.alpha, view.frame.hidden
        assert alpha is not None  # it has an outline
        matter = alpha > 0.5 if hidden is None else (alpha > 0.5) & ~hidden
        ray = rays_of(view, matter, RAYS_OF_VIEW)[0]
        directions.append(view.T_ref_camera.to(torch.float64).rotate(ray))
        origins.append(view.T_ref_camera.translation.double().expand_as(ray))
    return torch.cat(origins), torch.cat(directions)


def _votes(views: Sequence[View], points: Float[Tensor, "n 3"]) -> Int[Tensor, "n"]:
    """Return how many views see something (alpha over 0) at each point (metres, world)."""
    return torch.stack([_shows_something(view, points) for view in views]).sum(dim=0)


def _shows_something(view: View, points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
    camera, alpha, hidden = view.frame.intrinsics, view.frame.alpha, view.frame.hidden
    seen = view.T_ref_camera.to(torch.float64).inverse().apply(points).float()
    row, column, inside = camera.cells(seen)
    inside = inside if hidden is None else inside & ~hidden[row, column]
    return inside if alpha is None else inside & (alpha[row, column] > 0)
