"""Fields that consist of pieces (Gaussians, triangles, discs): ray hits, a density of the same opacity, and a sampler.

Pieces are found with a tree of boxes. Pieces are sorted along a Morton curve, eight neighbours share a box, eight of these boxes share the
next, and so on (Lauterbach et al. 2009, with eight children). The tree has no pointers: child ``c`` of node ``n`` is ``8 n + c`` on
the level below. The boxes of a node's children are stored side by side, as (6 nodes 8): lower corner, upper corner.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn
from torch.nn.functional import pad

from bidnerf_core.devices import may_wait
from bidnerf_core.fields import FieldValues, RayHits, Rays, RaySamples

LEAST_ALPHA = 1 / 255
"""Opacity of a piece along a ray below which it is not seen."""
LARGEST_ALPHA = 0.999
"""Largest opacity of a piece along a ray, as in gsplat: the optical thickness stays finite."""
CHILDREN = 8
"""Children of a node, and the largest number of nodes on the highest level, all of which are tested."""
MORTON_BITS = 16
"""Bits of each coordinate on the Morton curve."""
MOST_PAIRS = 2**22
"""Largest number of line-box pairs tested at once: some 300 MB."""
KEPT_HITS = 64
"""Number of pieces kept along a line if the number must be known beforehand; on each level, twice as many nodes are. The nearest are
kept."""

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class Meeting:
    """The intersections of pairs of a line and a piece."""

    distance: Float[Tensor, "*p"]  # metres along the line from its origin; may be negative
    alpha: Float[Tensor, "*p"]  # fraction of the light stopped there; 0 where the line misses
    key: Float[Tensor, "*p"]  # sort key of the pieces along a ray, such as the distance


class PieceField(nn.Module, ABC):
    """A field of pieces, such as Gaussians or triangles, each of which a ray intersects in a single point.

    ``hits`` returns these points with the opacity alpha of each piece. The density that ``query`` returns distributes the optical
    thickness ``-log(1 - alpha)`` along the line of sight, so that its integral along a ray gives the same opacity. A field
    calls ``register_tree`` once it knows the number of its pieces and ``rebuild`` whenever they have moved, and defines ``meet``,
    ``colours``, ``profile`` and ``half_length``.
    """

    order: Tensor
    reach: float | None = None
    """Metres from a piece's box within which the line of sight through a point must meet it for the piece to have density there;
    None if the box must contain the point."""

    @abstractmethod
    def meet(self, index: Int[Tensor, "p"], origins: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]) -> Meeting:
        """Return where lines meet the pieces with indices ``index``; an opacity below ``LEAST_ALPHA`` counts as none."""

    @abstractmethod
    def colours(
        self, index: Int[Tensor, "p"], meeting: Meeting, directions: Float[Tensor, "p 3"]
    ) -> Float[Tensor, "p 3"]:
        """Return the colours in [0, 1] of pieces where lines meet them."""

    @abstractmethod
    def profile(self, meeting: Meeting) -> Float[Tensor, "p"]:
        """Return the fraction per metre of a piece's optical thickness at the lines' origins; this profile integrates to 1 along a line."""

    @abstractmethod
    def half_length(self, meeting: Meeting) -> Float[Tensor, "p"]:
        """Return half the length (metres) of the interval that ``sampler`` places around a piece."""

    def register_tree(self, count: int) -> None:
        """Register the buffers of the tree of ``count`` pieces."""
        self.register_buffer("order", torch.arange(count))
        number, nodes = 0, count
        while number == 0 or nodes > CHILDREN:
            nodes = max(1, -(-nodes // CHILDREN))
            self.register_buffer(f"boxes_{number}", torch.zeros(6, nodes, CHILDREN))
            number += 1

    @property
    def boxes(self) -> list[Float[Tensor, "6 _ 8"]]:
        """The boxes of each node's children, starting with the lowest level (whose children are pieces)."""
        return [part for name, part in self.named_buffers(recurse=False) if name.startswith("boxes_")]

    def rebuild(self, centres: Float[Tensor, "n 3"], halves: Float[Tensor, "n 3"], seen: Bool[Tensor, "n"]) -> None:
        """Fill the tree from boxes with these centres and half sizes; pieces that are not ``seen`` get an empty box."""
        self.order.copy_(torch.argsort(_morton(centres, seen), stable=True))
        centres, halves, seen = centres[self.order], halves[self.order], seen[self.order, None]
        lower = torch.where(seen, centres - halves, torch.inf)
        upper = torch.where(seen, centres + halves, -torch.inf)
        for boxes in self.boxes:
            missing = boxes.shape[1] * CHILDREN - len(lower)
            low, high = (
                pad(part, (0, 0, 0, missing), value=fill).unflatten(0, (-1, CHILDREN))
                for part, fill in ((lower, torch.inf), (upper, -torch.inf))
            )
            boxes.copy_(torch.cat([low, high], dim=-1).movedim(-1, 0))
            lower, upper = low.amin(1), high.amax(1)

    @property
    def sampler(self) -> PieceSampler:
        """The sampler that places an interval around each piece."""
        return PieceSampler(self)

    def hits(self, rays: Rays) -> RayHits:
        """Return the hits of rays on pieces, with colour and alpha; differentiable in the rays and the parameters."""
        shape, flat = rays.near.shape, rays.flattened()
        piece, valid = self.met(flat)
        width = piece.shape[1]
        place = torch.arange(valid.numel(), device=valid.device)
        if may_wait(valid.device):
            place = valid.reshape(-1).nonzero()[:, 0]
        ray, index = place // max(1, width), piece.reshape(-1).index_select(0, place)
        directions = flat.directions.index_select(0, ray)
        found = self.meet(index, flat.origins.index_select(0, ray), directions)
        distance, alpha, rgb = (
            value.new_zeros((valid.numel(), *value.shape[1:]))
            .index_copy(0, place, value)
            .reshape(*shape, width, *value.shape[1:])
            for value in (found.distance, found.alpha, self.colours(index, found, directions))
        )
        valid = valid.reshape(*shape, width)
        distance = torch.where(valid, distance, rays.near[..., None])
        return RayHits(distance, torch.where(valid, alpha, 0), rgb, valid)

    @torch.no_grad()
    def met(self, rays: Rays, by_distance: bool = False) -> tuple[Int[Tensor, "r s"], Bool[Tensor, "r s"]]:
        """Return the indices of the pieces that rays (r) meet, in compositing order until the transmittance is negligible,
        and the mask of slots in use.

        The order is that of ``Meeting.key``, or of the distances with ``by_distance``.
        """
        waiting = may_wait(rays.near.device)

        def met_by_few(origins: Tensor, directions: Tensor, near: Tensor, far: Tensor) -> tuple[Tensor, Tensor]:
            last = torch.where(far > near, far, near - 1)  # rays that miss the scene meet nothing
            line, index, hit = self._nearby(origins, directions, near, last)
            found = self.meet(index, origins.index_select(0, line), directions.index_select(0, line))
            alpha, key, rays = found.alpha, found.distance if by_distance else found.key, len(near)
            hit = hit & (found.distance >= near.index_select(0, line)) & (alpha >= LEAST_ALPHA)
            hit = hit & (found.distance <= far.index_select(0, line))
            if waiting:
                kept = hit.nonzero()[:, 0]
                line, index, key, alpha = (part.index_select(0, kept) for part in (line, index, key, alpha))
                count = torch.bincount(line, minlength=rays)
                width = int(count.max()) if len(line) else 0
                place = line * width + torch.arange(len(line), device=line.device)
                place -= (count.cumsum(0) - count)[line]
                key, alpha, index = (
                    value.new_full((rays * width,), fill).index_copy(0, place, value)
                    for value, fill in ((key, torch.inf), (alpha, 0), (index, 0))
                )
            else:
                key, width = torch.where(hit, key, torch.inf), len(index) // max(1, rays)
            key, order = key.view(rays, width).sort(dim=1, stable=True)
            if not waiting:
                key, order = key[:, :KEPT_HITS], order[:, :KEPT_HITS]
            index = index.view(rays, width).gather(1, order)
            alpha = torch.where(key < torch.inf, alpha.view(rays, width).gather(1, order), 0)
            thickness = -torch.log1p(-alpha)
            # Nothing behind a transmittance of 1e-4 is considered, as in the code of 3D Gaussian splatting.
            valid = (key < torch.inf) & (thickness.cumsum(1) - thickness < -math.log(1e-4))
            if waiting:
                width = int(valid.sum(1).max()) if valid.numel() else 0
                return index[:, :width], valid[:, :width]
            return index, valid

        # What 384 rays meet stays in the processor's cache.
        some = 384 if waiting else max(1, len(rays.near))
        parts = _in_parts(met_by_few, tuple(vars(rays).values()), some)
        width = max(piece.shape[1] for piece, _ in parts)
        piece, valid = (
            torch.cat([pad(part, (0, width - part.shape[1])) for part in column]) for column in zip(*parts, strict=True)
        )
        return piece, valid

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return the density whose integral along ``directions`` gives the opacity of ``hits``, and the mean colour."""

        def values_of(places: Tensor, ways: Tensor) -> tuple[Tensor, Tensor]:
            with torch.no_grad():
                away = torch.full_like(places[:, 0], self.reach or 0.0)
                towards = torch.ones_like(ways) if self.reach is None else ways
                point, index, counts = self._nearby(places, towards, -away, away)
            towards = ways.index_select(0, point)
            found = self.meet(index, places.index_select(0, point), towards)
            counts = counts & (found.alpha >= LEAST_ALPHA)
            density = torch.where(counts, -torch.log1p(-found.alpha), 0) * self.profile(found)
            rgb = density[:, None] * self.colours(index, found, towards)
            total = density.new_zeros(len(places)).index_add(0, point, density)
            colour = rgb.new_zeros((len(places), 3)).index_add(0, point, rgb)
            return total, (colour / total.clamp(min=1e-20)[:, None]).clamp(0, 1)

        flat = positions.reshape(-1, 3), directions.reshape(-1, 3)
        density, rgb = map(torch.cat, zip(*_in_parts(values_of, flat, 2**15), strict=True))
        return FieldValues(density.reshape(positions.shape[:-1]), rgb.reshape(positions.shape))

    def _nearby(
        self,
        origins: Float[Tensor, "r 3"],
        directions: Float[Tensor, "r 3"],
        near: Float[Tensor, "r"],
        far: Float[Tensor, "r"],
    ) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"], Bool[Tensor, "p"]]:
        """Return pairs of a line and a piece whose box it crosses between ``near`` and ``far``, sorted by line, and which are valid.

        If the host must not wait, each line gets the same number of pairs, for the boxes that it enters first. Otherwise all pairs
        are returned and valid, and ``TooMany`` is raised if several lines meet so many boxes that memory might not suffice.
        """
        # Smaller components of a direction are replaced by this one, so that slopes stay finite.
        least = torch.full_like(directions, 1e-9)
        slopes = 1 / torch.where(directions.abs() < least, torch.copysign(least, directions), directions)
        offsets, slopes = -(origins * slopes).mT.contiguous(), slopes.mT.contiguous()
        lines, waiting, boxes = len(near), may_wait(near.device), self.boxes
        each, device = torch.arange(CHILDREN, device=near.device), near.device
        node = torch.arange(boxes[-1].shape[1], device=device).repeat(lines)
        line = torch.arange(lines, device=device).repeat_interleave(boxes[-1].shape[1])
        counts = torch.ones_like(node, dtype=torch.bool)
        for level in reversed(boxes):
            if waiting and lines > 1 and len(node) * CHILDREN > MOST_PAIRS:
                raise TooMany
            corners = level.index_select(1, node)
            enter, leave = near.index_select(0, line)[:, None], far.index_select(0, line)[:, None]
            for axis in range(3):
                offset, slope = (part[axis].index_select(0, line)[:, None] for part in (offsets, slopes))
                low, high = (torch.addcmul(offset, corners[side + axis], slope) for side in (0, 3))
                enter = torch.maximum(enter, torch.minimum(low, high))
                leave = torch.minimum(leave, torch.maximum(low, high))
            # The corners of an empty box are swapped and at infinity, so every line would lie within its slabs.
            hit = (enter <= leave) & (corners[0] <= corners[3])
            if waiting:
                parent, child = hit.nonzero(as_tuple=True)
                line, node = line.index_select(0, parent), node.index_select(0, parent) * CHILDREN + child
                continue
            key = torch.where(hit & counts[:, None], enter, torch.inf).view(lines, -1)
            children = (node[:, None] * CHILDREN + each).view(lines, -1)
            kept = key.topk(min(2 * KEPT_HITS, key.shape[1]), dim=1, largest=False)
            counts = (kept.values < torch.inf).reshape(-1)
            node = torch.where(counts, children.gather(1, kept.indices).reshape(-1), 0)
            line = torch.arange(lines, device=device).repeat_interleave(kept.values.shape[1])
        counts = torch.ones_like(node, dtype=torch.bool) if waiting else counts
        return line, self.order.index_select(0, node), counts


class TooMany(Exception):
    """The lines cross more boxes than can be tested at once; try again with fewer lines."""


def _in_parts(function: Callable[..., T], parts: Sequence[Tensor], count: int) -> list[T]:
    """Apply ``function`` to ``count`` rows of ``parts`` at a time, or to fewer where it raises ``TooMany``."""
    found: list[T] = []
    for few in zip(*(part.split(count) for part in parts), strict=True):
        try:
            found.append(function(*few))
        except TooMany:
            found += _in_parts(function, few, (len(few[0]) + 1) // 2)
    return found


def _morton(centres: Float[Tensor, "n 3"], seen: Bool[Tensor, "n"]) -> Int[Tensor, "n"]:
    """Return the position of each piece along a Morton curve; unseen pieces come last."""
    # Between quantiles, so that a few distant pieces do not put all others into one cell.
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
class PieceSampler:
    """A sampler that places an interval of length ``2 half_length`` around each piece that a ray meets.

    For an isolated piece, density times length is its optical thickness; if pieces overlap, their intervals
    end half-way between them. ``hits`` is exact, and is what the core renders.
    """

    field: PieceField

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        flat = rays.flattened()
        piece, valid = self.field.met(flat, by_distance=True)
        ray = torch.arange(len(piece), device=piece.device).repeat_interleave(piece.shape[1])
        origins, directions = (part.index_select(0, ray) for part in (flat.origins, flat.directions))
        found = self.field.meet(piece.reshape(-1), origins, directions)
        middle, half = (part.reshape(piece.shape) for part in (found.distance, self.field.half_length(found)))
        near, far = flat.near[:, None], torch.maximum(flat.near, flat.far)[:, None]
        starts = torch.where(valid, torch.maximum(middle - half, near), far)
        ends = torch.where(valid, torch.minimum(middle + half, far), far)
        place = torch.where(valid, middle, torch.inf)
        between = (place[:, 1:] + place[:, :-1]) / 2
        starts[:, 1:] = torch.maximum(starts[:, 1:], torch.where(valid[:, 1:], between, far))
        ends[:, :-1] = torch.where(valid[:, 1:], torch.minimum(ends[:, :-1], between), ends[:, :-1])
        return RaySamples(starts, torch.maximum(starts, ends), valid).unflattened(rays.near.shape)
