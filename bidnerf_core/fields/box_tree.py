"""A bounding volume hierarchy of the pieces of a scene (Gaussians, triangles, discs), which finds the few pieces that
a ray or point meets.

Pieces are sorted along a Morton curve, eight neighbours share a box, eight of these boxes share the next, and
so on (Lauterbach et al. 2009, with eight children). The tree has no pointers: child ``c`` of node ``n`` is ``8 n + c`` on the level below. The boxes of a node's children are
stored side by side, as (6 nodes 8): lower corner, upper corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

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
