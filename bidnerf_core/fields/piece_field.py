"""The base of fields that consist of pieces: what rays hit, the density that has the same opacity, and a sampler."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn

from bidnerf_core.fields.contract import FieldValues, RayHits, Rays, RaySamples
from bidnerf_core.fields.pieces import (
    Meeting,
    flattened,
    level_sizes,
    listed,
    met_pieces,
    pieces_about,
    tree_of,
    values_of_pieces,
)

LEAST_ALPHA = 1 / 255
"""Opacity of a piece along a ray below which it is not seen."""
LARGEST_ALPHA = 0.999
"""Largest opacity of a piece along a ray, as in gsplat: the optical thickness stays finite."""


class PieceField(nn.Module, ABC):
    """A field of pieces, such as Gaussians or triangles, each of which a ray meets at one point.

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
    def meet(
        self, index: Int[Tensor, "p"], origins: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> Meeting:
        """Return where lines meet the pieces with indices ``index``; an opacity below ``LEAST_ALPHA`` counts as none."""

    @abstractmethod
    def colours(
        self, index: Int[Tensor, "p"], meeting: Meeting, directions: Float[Tensor, "p 3"]
    ) -> Float[Tensor, "p 3"]:
        """Return the colours in [0, 1] of pieces where lines meet them."""

    @abstractmethod
    def profile(self, meeting: Meeting) -> Float[Tensor, "p"]:
        """Return the share per metre of a piece's optical thickness at the lines' origins; its integral along a line is 1."""

    @abstractmethod
    def half_length(self, meeting: Meeting) -> Float[Tensor, "p"]:
        """Return half the length (metres) of the interval that a piece has in ``sampler``."""

    def register_tree(self, count: int) -> None:
        """Register the buffers of the tree of ``count`` pieces."""
        self.register_buffer("order", torch.arange(count))
        for number, nodes in enumerate(level_sizes(count)):
            self.register_buffer(f"boxes_{number}", torch.zeros(6, nodes, 8))

    @property
    def boxes(self) -> list[Float[Tensor, "6 _ 8"]]:
        """The boxes of the tree, the lowest level first."""
        return [getattr(self, f"boxes_{number}") for number in range(len(level_sizes(len(self.order))))]

    def rebuild(
        self, centres: Float[Tensor, "n 3"], halves: Float[Tensor, "n 3"], seen: Bool[Tensor, "n"]
    ) -> None:
        """Set the tree for boxes with these centres and half sizes, without the pieces that are not ``seen``."""
        order, levels = tree_of(centres, halves, seen)
        self.order.copy_(order)
        for boxes, found in zip(self.boxes, levels, strict=True):
            boxes.copy_(found)

    @property
    def sampler(self) -> PieceSampler:
        """The sampler that places an interval around each piece."""
        return PieceSampler(self)

    def hits(self, rays: Rays) -> RayHits:
        """Return where rays meet pieces, with colour and alpha; differentiable in the rays and the parameters."""
        shape, flat = rays.near.shape, flattened(rays)
        piece, valid = self.met(flat)
        width = piece.shape[1]
        place, ray, index = listed(piece, valid)
        directions = flat.directions.index_select(0, ray)
        found = self.meet(index, flat.origins.index_select(0, ray), directions)
        parts = []
        for value in (found.distance, found.alpha, self.colours(index, found, directions)):
            whole = value.new_zeros((valid.numel(), *value.shape[1:]))
            parts.append(whole.index_copy(0, place, value).reshape(*shape, width, *value.shape[1:]))
        valid = valid.reshape(*shape, width)
        distance = torch.where(valid, parts[0], flat.near.reshape(*shape, 1))
        return RayHits(distance, torch.where(valid, parts[1], 0), parts[2], valid)

    @torch.no_grad()
    def met(self, rays: Rays, by_distance: bool = False) -> tuple[Int[Tensor, "r s"], Bool[Tensor, "r s"]]:
        """Return the indices of the pieces that rays (r) meet, in the order of compositing until the transmittance is
        negligible, and which slots are in use.

        The order is that of ``Meeting.key``, or of the distances with ``by_distance``.
        """

        def meet(index: Tensor, origins: Tensor, directions: Tensor) -> Meeting:
            found = self.meet(index, origins, directions)
            alpha = torch.where(found.alpha >= LEAST_ALPHA, found.alpha, 0)
            return Meeting(found.distance, alpha, found.distance if by_distance else found.key)

        return met_pieces(rays, self.boxes, self.order, meet)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return the density whose integral along ``directions`` gives the opacity of ``hits``, and the mean colour."""
        return values_of_pieces(positions, directions, self._about)

    def _about(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> tuple[Int[Tensor, "q"], Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the pairs of a point and a nearby piece, with density and colour."""
        with torch.no_grad():
            ways = None if self.reach is None else directions
            point, index, counts = pieces_about(positions, self.boxes, self.order, ways, self.reach or 0.0)
        towards = directions.index_select(0, point)
        found = self.meet(index, positions.index_select(0, point), towards)
        counts = counts & (found.alpha >= LEAST_ALPHA)
        density = torch.where(counts, -torch.log1p(-found.alpha), 0) * self.profile(found)
        return point, density, self.colours(index, found, towards)


@dataclass(frozen=True, eq=False)
class PieceSampler:
    """An interval around each piece that a ray meets, as long as its density there divided by its peak.

    For an isolated piece, density times length is its optical thickness; if several overlap, their intervals
    end half-way between them. ``hits`` is exact, and is what the core renders.
    """

    field: PieceField

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        shape, flat = rays.near.shape, flattened(rays)
        piece, valid = self.field.met(flat, by_distance=True)
        width = piece.shape[1]
        ray = torch.arange(len(piece), device=piece.device)[:, None].expand(piece.shape).reshape(-1)
        found = self.field.meet(
            piece.reshape(-1), flat.origins.index_select(0, ray), flat.directions.index_select(0, ray)
        )
        middle, half = (part.reshape(piece.shape) for part in (found.distance, self.field.half_length(found)))
        near, far = flat.near[:, None], torch.maximum(flat.near, flat.far)[:, None]
        starts = torch.where(valid, torch.maximum(middle - half, near), far)
        ends = torch.where(valid, torch.minimum(middle + half, far), far)
        if width > 1:
            place = torch.where(valid, middle, torch.inf)
            between = (place[:, 1:] + place[:, :-1]) / 2
            starts[:, 1:] = torch.maximum(starts[:, 1:], torch.where(valid[:, 1:], between, far))
            ends[:, :-1] = torch.where(valid[:, 1:], torch.minimum(ends[:, :-1], between), ends[:, :-1])
        ends = torch.maximum(starts, ends)
        return RaySamples(*(part.reshape(*shape, width) for part in (starts, ends, valid)))
