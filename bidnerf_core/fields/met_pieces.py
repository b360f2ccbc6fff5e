"""Intersections of rays with the pieces of a scene (Gaussians, triangles, discs), found with a tree of boxes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from bidnerf_core.devices import may_wait
from bidnerf_core.fields.box_tree import Boxes, Lines, TooMany, met, nearest_met
from bidnerf_core.fields.contract import FieldValues, Rays

STOPPED = 1e-4
"""Transmittance below which nothing behind is considered, as in the code of 3D Gaussian splatting."""
RAYS_AT_ONCE = 384
"""Number of rays looked up together: small enough for what they meet to stay in the processor's cache."""
POINTS_AT_ONCE = 2**15
"""Number of points looked up together."""
KEPT_HITS = 64
"""Number of pieces kept along a ray if the number must be known beforehand; the nearest ones are kept."""


@dataclass(frozen=True, eq=False)
class Meeting:
    """The intersections of pairs of a line and a piece."""

    distance: Float[Tensor, "*p"]  # metres along the line from its origin; may be negative
    alpha: Float[Tensor, "*p"]  # fraction of the light stopped there; 0 where the line misses
    key: Float[Tensor, "*p"]  # sort key of the pieces along a ray, such as the distance


Meet: TypeAlias = Callable[[Int[Tensor, "p"], Float[Tensor, "p 3"], Float[Tensor, "p 3"]], Meeting]
"""A function from piece indices and the origins and directions of lines to their intersections."""


def met_pieces(
    rays: Rays, boxes: Boxes, order: Int[Tensor, "n"], meet: Meet
) -> tuple[Int[Tensor, "r s"], Bool[Tensor, "r s"]]:
    """Return the indices of the pieces that rays (r) hit, in key order until the transmittance is negligible, and
    which slots are in use.
    """
    if not len(rays.near):
        empty = torch.zeros((0, 0), dtype=torch.long, device=order.device)
        return empty, empty.bool()
    if not may_wait(rays.near.device):
        return _met_in_known_shape(rays, boxes, order, meet)
    parts = _met_in_parts(rays, RAYS_AT_ONCE, boxes, order, meet)
    width = max(piece.shape[1] for piece, _ in parts)
    piece, valid = (
        torch.cat([pad(part[i], (0, width - part[i].shape[1])) for part in parts]) for i in range(2)
    )
    return piece, valid


def _met_in_parts(
    rays: Rays, count: int, boxes: Boxes, order: Tensor, meet: Meet
) -> list[tuple[Tensor, Tensor]]:
    parts = zip(
        *(getattr(rays, n).split(count) for n in ("origins", "directions", "near", "far")), strict=True
    )
    found = []
    for part in parts:
        few = Rays(*part)
        try:
            found.append(_met_by_few(few, boxes, order, meet))
        except TooMany:
            found += _met_in_parts(few, (len(few.near) + 1) // 2, boxes, order, meet)
    return found


def _met_by_few(rays: Rays, boxes: Boxes, order: Tensor, meet: Meet) -> tuple[Tensor, Tensor]:
    ray, index = met(_lines(rays), boxes, order)
    found = meet(index, rays.origins.index_select(0, ray), rays.directions.index_select(0, ray))
    kept = _is_hit(found, rays.near.index_select(0, ray), rays.far.index_select(0, ray)).nonzero()[:, 0]
    ray, index, key, alpha = (part.index_select(0, kept) for part in (ray, index, found.key, found.alpha))
    count = torch.bincount(ray, minlength=len(rays.near))
    width = int(count.max()) if len(ray) else 0
    place = ray * width + torch.arange(len(ray), device=ray.device) - (count.cumsum(0) - count)[ray]
    rows = (len(rays.near), width)
    return _in_order(*(
        value.new_full((rows[0] * width,), fill).index_copy(0, place, value).reshape(rows)
        for value, fill in ((key, torch.inf), (alpha, 0), (index, 0))
    ))  # fmt: skip


def _met_in_known_shape(rays: Rays, boxes: Boxes, order: Tensor, meet: Meet) -> tuple[Tensor, Tensor]:
    index, valid = nearest_met(_lines(rays), boxes, order)
    ray = torch.arange(len(index), device=index.device)[:, None].expand(index.shape).reshape(-1)
    found = meet(index.reshape(-1), rays.origins.index_select(0, ray), rays.directions.index_select(0, ray))
    near, far = (part.index_select(0, ray) for part in (rays.near, rays.far))
    hit = _is_hit(found, near, far).reshape(index.shape) & valid
    key = torch.where(hit, found.key.reshape(index.shape), torch.inf)
    kept = key.topk(min(KEPT_HITS, key.shape[1]), dim=1, largest=False, sorted=True).indices
    alpha = torch.where(hit, found.alpha.reshape(index.shape), 0)
    return _in_order(*(part.gather(1, kept) for part in (key, alpha, index)))


def _lines(rays: Rays) -> Lines:
    far = torch.where(rays.far > rays.near, rays.far, rays.near - 1)  # rays that miss the scene meet nothing
    return Lines.of(rays.origins, rays.directions, rays.near, far)


def _is_hit(found: Meeting, near: Float[Tensor, "p"], far: Float[Tensor, "p"]) -> Bool[Tensor, "p"]:
    return (found.alpha > 0) & (found.distance >= near) & (found.distance <= far)


def _in_order(
    key: Float[Tensor, "r s"], alpha: Float[Tensor, "r s"], index: Int[Tensor, "r s"]
) -> tuple[Int[Tensor, "r k"], Bool[Tensor, "r k"]]:
    """Return the indices in order of ``key``, and which of them are reached by any light."""
    key, order = key.sort(dim=1, stable=True)
    alpha, index = alpha.gather(1, order), index.gather(1, order)
    thickness = -torch.log1p(-alpha)
    before = thickness.cumsum(1) - thickness
    valid = (key < torch.inf) & (before < -math.log(STOPPED))
    if may_wait(valid.device):
        width = int(valid.sum(1).max()) if valid.numel() else 0
        return index[:, :width], valid[:, :width]
    return index, valid


def pieces_about(
    positions: Float[Tensor, "p 3"], boxes: Boxes, order: Int[Tensor, "n"],
    directions: Float[Tensor, "p 3"] | None = None, reach: float = 0.0,
) -> tuple[Int[Tensor, "q"], Int[Tensor, "q"], Bool[Tensor, "q"]]:  # fmt: skip
    """Return pairs of a point and a piece whose box contains it, and whether each pair counts.

    With unit ``directions``, the line through the point must meet the piece's box within ``reach`` (metres)
    in either direction. If the host must not wait, each point has equally many pairs, some of which do not
    count. Raises ``TooMany`` if several points lie in so many boxes that memory might not suffice.
    """
    away = torch.full_like(positions[:, 0], reach)
    lines = Lines.of(positions, torch.ones_like(positions) if directions is None else directions, -away, away)
    if may_wait(positions.device):
        point, index = met(lines, boxes, order)
        return point, index, torch.ones_like(point, dtype=torch.bool)
    index, valid = nearest_met(lines, boxes, order)
    point = torch.arange(len(index), device=index.device)[:, None].expand(index.shape)
    return point.reshape(-1), index.reshape(-1), valid.reshape(-1)


AboutPoints: TypeAlias = Callable[
    [Float[Tensor, "p 3"], Float[Tensor, "p 3"]],
    tuple[Int[Tensor, "q"], Float[Tensor, "q"], Float[Tensor, "q 3"]],
]
"""A function from positions and directions to pairs of a point and a piece: the point's index, the density
(1/metre), the colour.

It may raise ``TooMany``, as ``pieces_about`` does.
"""


def values_of_pieces(
    positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"], about: AboutPoints
) -> FieldValues:
    """Return the sum of the pieces' densities at points, and their density-weighted mean colour."""
    shape = positions.shape[:-1]
    places, ways = (part.reshape(-1, 3).split(POINTS_AT_ONCE) for part in (positions, directions))
    found = _joined([_values(place, way, about) for place, way in zip(places, ways, strict=True)])
    return FieldValues(found.density.reshape(shape), found.rgb.reshape(*shape, 3))


def _values(
    positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"], about: AboutPoints
) -> FieldValues:
    try:
        point, density, rgb = about(positions, directions)
    except TooMany:
        halves = zip(positions.chunk(2), directions.chunk(2), strict=True)
        return _joined([_values(place, way, about) for place, way in halves])
    count = len(positions)
    total = density.new_zeros(count).index_add(0, point, density)
    colour = rgb.new_zeros((count, 3)).index_add(0, point, density[:, None] * rgb)
    return FieldValues(total, (colour / total.clamp(min=1e-20)[:, None]).clamp(0, 1))


def _joined(parts: list[FieldValues]) -> FieldValues:
    return FieldValues(torch.cat([part.density for part in parts]), torch.cat([part.rgb for part in parts]))


def listed(
    index: Int[Tensor, "r s"], valid: Bool[Tensor, "r s"]
) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"], Int[Tensor, "p"]]:
    """Return slot, row and index of the valid entries or, if the host must not wait, of all entries."""
    if may_wait(valid.device):
        place = valid.reshape(-1).nonzero()[:, 0]
    else:
        place = torch.arange(valid.numel(), device=valid.device)
    return place, place // max(1, valid.shape[1]), index.reshape(-1).index_select(0, place)


def flattened(rays: Rays) -> Rays:
    """Return rays of any shape flattened to one axis."""
    return Rays(
        rays.origins.reshape(-1, 3), rays.directions.reshape(-1, 3), rays.near.reshape(-1), rays.far.reshape(-1)
    )  # fmt: skip
