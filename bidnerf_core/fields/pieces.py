"""Intersections of rays and points with the pieces of a scene (Gaussians, triangles, discs), found with a tree of boxes.

Pieces are sorted along a Morton curve, eight neighbours share a box, eight of these boxes share the next, and
so on (Lauterbach et al. 2009, with eight children). The tree has no pointers: child ``c`` of node ``n`` is ``8 n + c`` on the
level below. The boxes of a node's children are stored side by side, as (6 nodes 8): lower corner, upper corner.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from bidnerf_core.devices import may_wait
from bidnerf_core.fields.contract import FieldValues, Rays

CHILDREN = 8
TOP = 8
"""Largest number of nodes on the highest level; all of them are tested."""
MORTON_BITS = 16
"""Bits of each coordinate on the Morton curve."""
LEAST_COMPONENT = 1e-9
"""Smallest magnitude of a direction's component along an axis; smaller ones are replaced by it, so that
slopes stay finite."""
MOST_PAIRS = 2**22
"""Largest number of ray-box pairs tested at once: some 300 MB."""
KEPT_NODES = 128
"""Number of nodes kept per ray on each level if the number must be known beforehand; the nearest ones are kept."""
STOPPED = 1e-4
"""Transmittance below which nothing behind is considered, as in the code of 3D Gaussian splatting."""
RAYS_AT_ONCE = 384
"""Number of rays looked up together: small enough for what they meet to stay in the processor's cache."""
POINTS_AT_ONCE = 2**15
"""Number of points looked up together."""
KEPT_HITS = 64
"""Number of pieces kept along a ray if the number must be known beforehand; the nearest ones are kept."""

Boxes = Sequence[Float[Tensor, "6 _ 8"]]
"""The boxes of the children of each node, the lowest level (whose children are pieces) first."""


def level_sizes(count: int) -> list[int]:
    """Return the number of nodes on each level above ``count`` pieces, the lowest first."""
    sizes = [max(1, -(-count // CHILDREN))]
    while sizes[-1] > TOP:
        sizes.append(-(-sizes[-1] // CHILDREN))
    return sizes


def tree_of(
    centres: Float[Tensor, "n 3"], halves: Float[Tensor, "n 3"], seen: Bool[Tensor, "n"]
) -> tuple[Int[Tensor, "n"], list[Float[Tensor, "6 _ 8"]]]:
    """Return the order of the pieces, and the boxes of all levels. Pieces that are not ``seen`` are in an empty box."""
    order = torch.argsort(_morton(centres, seen), stable=True)
    centres, halves, seen = centres[order], halves[order], seen[order]
    lower = torch.where(seen[:, None], centres - halves, torch.inf)
    upper = torch.where(seen[:, None], centres + halves, -torch.inf)
    levels = []
    for size in level_sizes(len(order)):
        missing = size * CHILDREN - len(lower)
        low, high = (
            pad(part, (0, 0, 0, missing), value=fill).reshape(size, CHILDREN, 3)
            for part, fill in ((lower, torch.inf), (upper, -torch.inf))
        )
        levels.append(torch.cat([low, high], dim=-1).movedim(-1, 0).contiguous())
        lower, upper = low.amin(1), high.amax(1)
    return order, levels


def _morton(centres: Float[Tensor, "n 3"], seen: Bool[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Return the positions along a Morton curve; unseen pieces come last."""
    # Quantiles, so that a few distant pieces do not put all others into one cell.
    some = centres[:: max(1, len(centres) // 10_000)].double()
    low, high = (some.quantile(q, dim=0) for q in (0.02, 0.98))
    side = (high - low).amax().clamp(min=1e-12)
    inside = ((centres.double() - low) / side).clamp(-1, 2) / 3 + 1 / 3
    cells = (inside * (2**MORTON_BITS - 1)).long()
    code = torch.zeros_like(cells[:, 0])
    for bit in range(MORTON_BITS):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return torch.where(seen, code, 2 ** (3 * MORTON_BITS))


@dataclass(frozen=True, eq=False)
class Lines:
    """Segments of rays, prepared for box tests. A point is a ray of zero length."""

    offsets: Float[Tensor, "3 r"]  # -origin / direction
    slopes: Float[Tensor, "3 r"]  # 1 / direction, finite
    near: Float[Tensor, "r"]
    far: Float[Tensor, "r"]

    @classmethod
    def of(
        cls, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"], near: Tensor, far: Tensor
    ) -> Lines:
        least = torch.full_like(directions, LEAST_COMPONENT)
        slopes = 1 / torch.where(directions.abs() < least, torch.copysign(least, directions), directions)
        return cls(-(origins * slopes).mT.contiguous(), slopes.mT.contiguous(), near, far)

    def entered(
        self, rays: Int[Tensor, "p"], boxes: Float[Tensor, "6 p 8"]
    ) -> tuple[Float[Tensor, "p 8"], Bool[Tensor, "p 8"]]:
        """Return where the rays with indices ``rays`` enter each of the boxes, and whether they meet it
        within their segment.
        """
        offsets, slopes = (
            self.offsets.index_select(1, rays)[..., None],
            self.slopes.index_select(1, rays)[..., None],
        )
        enter, leave = self.near.index_select(0, rays)[:, None], self.far.index_select(0, rays)[:, None]
        for axis in range(3):
            low, high = (
                torch.addcmul(offsets[axis], corner[axis], slopes[axis]) for corner in (boxes[:3], boxes[3:])
            )
            enter = torch.maximum(enter, torch.minimum(low, high))
            leave = torch.minimum(leave, torch.maximum(low, high))
        # The corners of an empty box are swapped, at infinity, and its slabs would hold all rays.
        return enter, (enter <= leave) & (boxes[0] <= boxes[3])


class TooMany(Exception):
    """The rays meet more boxes than may be tested at once; fewer rays may work."""


def met(lines: Lines, boxes: Boxes, order: Int[Tensor, "n"]) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
    """Return all pairs of a ray and a piece whose box it meets, sorted by ray. Their number is read from the
    device.

    Raises ``TooMany`` if several rays meet so many boxes that memory might not suffice.
    """
    rays = len(lines.near)
    top = boxes[-1].shape[1]
    ray = torch.arange(rays, device=order.device).repeat_interleave(top)
    node = torch.arange(top, device=order.device).repeat(rays)
    for level in reversed(boxes):
        if rays > 1 and len(node) * CHILDREN > MOST_PAIRS:
            raise TooMany
        _, hit = lines.entered(ray, level.index_select(1, node))
        parent, child = hit.nonzero(as_tuple=True)
        ray, node = ray.index_select(0, parent), node.index_select(0, parent) * CHILDREN + child
    return ray, order.index_select(0, node)


def nearest_met(
    lines: Lines, boxes: Boxes, order: Int[Tensor, "n"]
) -> tuple[Int[Tensor, "r c"], Bool[Tensor, "r c"]]:
    """Return the pieces whose boxes each ray meets first, and which of these slots are in use; the shape is
    known beforehand.
    """
    rays = len(lines.near)
    node = torch.arange(boxes[-1].shape[1], device=order.device).expand(rays, -1)
    valid = torch.ones_like(node, dtype=torch.bool)
    each = torch.arange(CHILDREN, device=order.device)
    for level in reversed(boxes):
        width = node.shape[1]
        ray = torch.arange(rays, device=order.device)[:, None].expand(-1, width).reshape(-1)
        enter, hit = lines.entered(ray, level.index_select(1, node.reshape(-1)))
        hit = hit.reshape(rays, width, CHILDREN) & valid[..., None]
        key = torch.where(hit, enter.reshape(hit.shape), torch.inf).flatten(1)
        child = (node[..., None] * CHILDREN + each).flatten(1)
        kept = key.topk(min(KEPT_NODES, key.shape[1]), dim=1, largest=False)
        node, valid = child.gather(1, kept.indices), kept.values < torch.inf
        node = torch.where(valid, node, 0)
    return order.index_select(0, node.reshape(-1)).reshape(node.shape), valid


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
