"""Triangles and discs as a radiance field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn

from bidnerf_core.fields import (
    FieldValues,
    Meeting,
    RayHits,
    Rays,
    RaySamples,
    SceneBounds,
    flattened,
    level_sizes,
    listed,
    met_pieces,
    pieces_about,
    tree_of,
    values_of_pieces,
)
from bidnerf_core.settings import NotNegative, Range
from bidnerf_scan.pieces import Pieces

LARGEST_ALPHA = 0.999
"""Opacity of one piece, at most."""
LEAST_ALPHA = 1 / 255
ROUNDING = 2e-6
"""Relative error of a position on a ray in single precision: triangles extend beyond their edges by it."""
FLATTEST = 1e-6
"""Sine of the angle between a ray and a plane below which they do not meet."""
THICKNESS = 0.005
"""Thickness of a surface when rays are sampled, in units of the scene's side."""


@dataclass(frozen=True)
class FieldConfig:
    """Size of the field."""

    pieces: Annotated[int, Range(1, 2 * 10**8)] = 30_000  # number of triangles or discs
    images: Annotated[int, Range(0, 10**6)] = 0  # number of textures
    texels: Annotated[int, Range(0, 2 * 10**9)] = 0  # number of their pixels
    # half of the depth (metres) over which density is spread around a surface; 0: proportional to the scene's
    # side
    thickness: NotNegative = 0.0


@dataclass(frozen=True, eq=False)
class _Crossings:
    """Where lines cross the planes of pieces."""

    distance: Float[Tensor, "p"]  # metres along the line
    u: Float[Tensor, "p"]
    v: Float[Tensor, "p"]
    alpha: Float[Tensor, "p"]  # 0 outside the piece


class ScanField(nn.Module):
    """Flat pieces: opaque triangles, and discs that fade towards their rims.

    ``hits`` returns the exact points where a ray crosses them, nearest first. The density that ``query``
    returns spreads each piece's optical thickness ``-log(1 - alpha)`` over ``thickness`` before and behind
    it, along the direction from which it is seen, so that its integral along a ray gives the same opacity.
    """

    corner: Tensor
    first: Tensor
    second: Tensor
    is_round: Tensor
    order: Tensor
    texels: Tensor
    shapes: Tensor
    image: Tensor
    uv: Tensor

    def __init__(self, config: FieldConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.config, self.bounds = config, bounds
        count = config.pieces
        lower, size = torch.tensor(bounds.lower), torch.tensor(bounds.size)
        radius = bounds.side / math.sqrt(max(4.0, count))
        edges = torch.linalg.qr(torch.randn(count, 3, 2)).Q * radius
        self.register_buffer("corner", lower + size * torch.rand(count, 3))
        self.register_buffer("first", edges[..., 0].contiguous())
        self.register_buffer("second", edges[..., 1].contiguous())
        self.register_buffer("is_round", torch.ones(count, dtype=torch.bool))
        rgb = torch.zeros(count, 3, 3)
        rgb[:, 0] = torch.rand(count, 3)
        self.rgb = nn.Parameter(rgb)
        self.logits = nn.Parameter(torch.full((count,), -2.0))
        if config.texels:
            self.register_buffer("texels", torch.zeros(config.texels, 3, dtype=torch.uint8))
            self.register_buffer("shapes", torch.ones(config.images, 3, dtype=torch.long))
            self.register_buffer("image", torch.full((count,), -1))
            self.register_buffer("uv", torch.zeros(count, 3, 2))
        self.register_buffer("order", torch.arange(count))
        for number, nodes in enumerate(level_sizes(count)):
            self.register_buffer(f"boxes_{number}", torch.zeros(6, nodes, 8))
        self.refit()

    @property
    def boxes(self) -> list[Float[Tensor, "6 _ 8"]]:
        """The boxes of the tree, the lowest level first, see ``pieces``."""
        return [getattr(self, f"boxes_{number}") for number in range(len(level_sizes(len(self.corner))))]

    @property
    def thickness(self) -> float:
        """Metres over which density is spread in front of and behind a surface."""
        return self.config.thickness or THICKNESS * self.bounds.side

    @torch.no_grad()
    def refit(self) -> None:
        """Rebuild the tree after pieces have moved."""
        disc = (self.first.square() + self.second.square()).sqrt()
        corners = torch.stack([torch.zeros_like(self.first), self.first, self.second])
        low, high = corners.amin(0), corners.amax(0)
        low = torch.where(self.is_round[:, None], -disc, low)
        high = torch.where(self.is_round[:, None], disc, high)
        middle = self.corner + (low + high) / 2
        # Slightly wider, so that rounding hides no piece whose box is flat.
        size = torch.linalg.vector_norm(high - low, dim=-1, keepdim=True)
        half = (high - low) / 2 + 1e-3 * size + 4e-7 * (self.bounds.far + middle.abs())
        order, levels = tree_of(middle, half, torch.ones_like(self.is_round))
        self.order.copy_(order)
        for boxes, found in zip(self.boxes, levels, strict=True):
            boxes.copy_(found)

    @torch.no_grad()
    def assign(self, pieces: Pieces) -> None:
        """Copy the same number of pieces, with the same numbers of textures and texels."""
        for name in ("corner", "first", "second", "rgb", "logits", "is_round"):
            getattr(self, name).copy_(getattr(pieces, name))
        if pieces.textures is not None:
            for name in ("texels", "shapes", "image", "uv"):
                getattr(self, name).copy_(getattr(pieces.textures, name))
        self.refit()

    @property
    def sampler(self) -> SurfaceSampler:
        """The sampler that places an interval around each surface."""
        return SurfaceSampler(self)

    def hits(self, rays: Rays) -> RayHits:
        """Return where rays cross pieces, with colour and alpha; differentiable in the rays, colours and opacities."""
        shape, flat = rays.near.shape, flattened(rays)
        piece, valid = self.met(flat)
        width = piece.shape[1]
        place, ray, index = listed(piece, valid)
        found = self._crossings(
            index, flat.origins.index_select(0, ray), flat.directions.index_select(0, ray)
        )
        parts = []
        for value in (found.distance, found.alpha, self._colours(index, found.u, found.v)):
            whole = value.new_zeros((valid.numel(), *value.shape[1:]))
            parts.append(whole.index_copy(0, place, value).reshape(*shape, width, *value.shape[1:]))
        valid = valid.reshape(*shape, width)
        distance = torch.where(valid, parts[0], flat.near.reshape(*shape, 1))
        return RayHits(distance, torch.where(valid, parts[1], 0), parts[2], valid)

    @torch.no_grad()
    def met(self, rays: Rays) -> tuple[Int[Tensor, "r s"], Bool[Tensor, "r s"]]:
        """Return the indices of the pieces that rays (r) cross, nearest first, until the transmittance is negligible."""

        def meet(index: Tensor, origins: Tensor, directions: Tensor) -> Meeting:
            found = self._crossings(index, origins, directions)
            alpha = torch.where(found.alpha >= LEAST_ALPHA, found.alpha, 0)
            return Meeting(found.distance, alpha, found.distance)

        return met_pieces(rays, self.boxes, self.order, meet)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return the density whose integral along ``directions`` gives the opacity of ``hits``, and the mean colour."""
        return values_of_pieces(positions, directions, self._about)

    def _about(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> tuple[Int[Tensor, "q"], Float[Tensor, "q"], Float[Tensor, "q 3"]]:
        """Return the pairs of a point and a nearby piece, with density and colour."""
        with torch.no_grad():
            point, index, counts = pieces_about(positions, self.boxes, self.order, directions, self.thickness)
        crossed = self._crossings(index, positions.index_select(0, point), directions.index_select(0, point))
        near = (crossed.distance / self.thickness).square()
        counts = counts & (near < 1) & (crossed.alpha >= LEAST_ALPHA)
        # The biweight kernel: its integral over a line is 1.
        profile = (1 - torch.where(counts, near, 1)).square() * (15 / 16 / self.thickness)
        density = torch.where(counts, -torch.log1p(-crossed.alpha) * profile, 0)
        rgb = self._colours(index, crossed.u, crossed.v)
        return point, density, rgb

    def _crossings(
        self, index: Int[Tensor, "p"], origins: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> _Crossings:
        """Return where lines cross the planes of the pieces with indices ``index`` (Moeller and Trumbore 1997)."""
        corner, first, second, logits, is_round = (
            part.index_select(0, index)
            for part in (self.corner, self.first, self.second, self.logits, self.is_round)
        )
        normal = torch.linalg.cross(first, second)
        area = torch.linalg.vector_norm(normal, dim=-1).clamp(min=1e-30)
        unit = normal / area[:, None]
        slope = (unit * directions).sum(-1)
        meets = slope.abs() > FLATTEST
        away = corner - origins
        distance = (away * unit).sum(-1) / torch.where(meets, slope, 1)
        place = distance[:, None] * directions - away
        u = (torch.linalg.cross(place, second) * unit).sum(-1) / area
        v = (torch.linalg.cross(first, place) * unit).sum(-1) / area
        radius = u.square() + v.square()
        faded = (1 - radius).clamp(min=0).square()
        longest = torch.linalg.vector_norm(torch.maximum(first.abs(), second.abs()), dim=-1)
        slack = 1e-5 + (ROUNDING * torch.linalg.vector_norm(away, dim=-1) * longest / area).clamp(max=0.1)
        inside = ((u > -slack) & (v > -slack) & (u + v < 1 + slack)).to(faded)
        share = torch.where(is_round, faded, inside.detach())
        alpha = (logits.sigmoid() * share).clamp(max=LARGEST_ALPHA)
        return _Crossings(
            torch.where(meets, distance, 0), torch.where(meets, u, 0), torch.where(meets, v, 0),
            torch.where(meets, alpha, 0),
        )  # fmt: skip

    @torch.no_grad()
    def colours_at(
        self, piece: Int[Tensor, "p"], u: Float[Tensor, "p"], v: Float[Tensor, "p"]
    ) -> Float[Tensor, "p 3"]:
        """Return the colours of pieces at the coordinates u and v, see ``Pieces``."""
        return self._colours(piece, u, v)

    def _colours(
        self, index: Int[Tensor, "p"], u: Float[Tensor, "p"], v: Float[Tensor, "p"]
    ) -> Float[Tensor, "p 3"]:
        rgb = self.rgb.index_select(0, index)
        found = rgb[:, 0] + u.clamp(-1, 1)[:, None] * rgb[:, 1] + v.clamp(-1, 1)[:, None] * rgb[:, 2]
        if self.config.texels:
            found = found * self._textured(index, u, v)
        return found.clamp(0, 1)

    def _textured(self, index: Tensor, u: Tensor, v: Tensor) -> Float[Tensor, "p 3"]:
        """Return the textures' colours, repeated beyond their borders; white for pieces without one."""
        uv, image = self.uv.index_select(0, index), self.image.index_select(0, index)
        start, width, height = self.shapes.index_select(0, image.clamp(min=0)).unbind(-1)
        place = uv[:, 0] + u[:, None] * uv[:, 1] + v[:, None] * uv[:, 2]
        x, y = place[:, 0] * width - 0.5, (1 - place[:, 1]) * height - 0.5
        column, row = x.detach().floor(), y.detach().floor()
        right, down = x - column, y - row
        total = torch.zeros_like(u)[:, None].expand(-1, 3)
        for step_x, step_y in ((0, 0), (1, 0), (0, 1), (1, 1)):
            texel = start + ((row.long() + step_y) % height) * width + (column.long() + step_x) % width
            weight = (right if step_x else 1 - right) * (down if step_y else 1 - down)
            total = total + weight[:, None] * (self.texels.index_select(0, texel).to(u) / 255)
        return torch.where(image[:, None] >= 0, total, 1)


@dataclass(frozen=True, eq=False)
class SurfaceSampler:
    """An interval around each piece that a ray crosses, as long as its density there divided by its peak.

    If pieces are close together, their intervals end half-way between them. ``hits`` is exact, and is what
    the core renders.
    """

    field: ScanField

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        shape, flat = rays.near.shape, flattened(rays)
        piece, valid = self.field.met(flat)
        width = piece.shape[1]
        ray = torch.arange(len(piece), device=piece.device)[:, None].expand(piece.shape).reshape(-1)
        found = self.field._crossings(
            piece.reshape(-1), flat.origins.index_select(0, ray), flat.directions.index_select(0, ray)
        )
        middle, half = found.distance.reshape(piece.shape), 8 / 15 * self.field.thickness
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
