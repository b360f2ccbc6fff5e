"""Triangles and discs as a radiance field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from bidnerf_core.fields import SceneBounds
from bidnerf_core.settings import NotNegative, Range
from bidnerf_gaussians.pieces import LARGEST_ALPHA, Meeting, PieceField
from bidnerf_scan.pieces import Pieces


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
class Crossings(Meeting):
    """Where lines cross the planes of pieces, in the coordinates of ``Pieces``."""

    u: Float[Tensor, "p"]
    v: Float[Tensor, "p"]


class ScanField(PieceField):
    """Flat pieces: opaque triangles, and discs that fade towards their rims.

    ``hits`` returns the exact points where a ray crosses them, nearest first. The density that ``query``
    returns spreads each piece's optical thickness ``-log(1 - alpha)`` over ``thickness`` before and behind
    it, along the direction from which it is seen, so that its integral along a ray gives the same opacity.
    """

    corner: Tensor
    first: Tensor
    second: Tensor
    is_round: Tensor
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
        self.register_tree(count)
        self.refit()

    @property
    def reach(self) -> float:  # type: ignore[override]
        """Metres over which density is spread in front of and behind a surface."""
        # By default, the thickness is proportional to the scene's side.
        return self.config.thickness or 0.005 * self.bounds.side

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
        self.rebuild(middle, half, torch.ones_like(self.is_round))

    @torch.no_grad()
    def assign(self, pieces: Pieces) -> None:
        """Copy the same number of pieces, with the same numbers of textures and texels."""
        for name in ("corner", "first", "second", "rgb", "logits", "is_round"):
            getattr(self, name).copy_(getattr(pieces, name))
        if pieces.textures is not None:
            for name in ("texels", "shapes", "image", "uv"):
                getattr(self, name).copy_(getattr(pieces.textures, name))
        self.refit()

    def meet(
        self, index: Int[Tensor, "p"], origins: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"]
    ) -> Crossings:
        """Return where lines cross the planes of the pieces with indices ``index`` (Moeller and Trumbore 1997)."""
        corner, first, second, logits, is_round = (
            part.index_select(0, index) for part in (self.corner, self.first, self.second, self.logits, self.is_round)
        )
        normal = torch.linalg.cross(first, second)
        area = torch.linalg.vector_norm(normal, dim=-1).clamp(min=1e-30)
        unit = normal / area[:, None]
        slope = (unit * directions).sum(-1)
        meets = slope.abs() > 1e-6  # the sine of the angle between the ray and the plane
        away = corner - origins
        distance = (away * unit).sum(-1) / torch.where(meets, slope, 1)
        place = distance[:, None] * directions - away
        u = (torch.linalg.cross(place, second) * unit).sum(-1) / area
        v = (torch.linalg.cross(first, place) * unit).sum(-1) / area
        radius = u.square() + v.square()
        faded = (1 - radius).clamp(min=0).square()
        longest = torch.linalg.vector_norm(torch.maximum(first.abs(), second.abs()), dim=-1)
        # Triangles extend beyond their edges by the relative error of a position on a ray in single precision.
        slack = 1e-5 + (2e-6 * torch.linalg.vector_norm(away, dim=-1) * longest / area).clamp(max=0.1)
        inside = ((u > -slack) & (v > -slack) & (u + v < 1 + slack)).to(faded)
        share = torch.where(is_round, faded, inside.detach())
        alpha = (logits.sigmoid() * share).clamp(max=LARGEST_ALPHA)
        distance, u, v, alpha = (torch.where(meets, part, 0) for part in (distance, u, v, alpha))
        return Crossings(distance, alpha, distance, u, v)

    def profile(self, meeting: Meeting) -> Float[Tensor, "p"]:
        near = (meeting.distance / self.reach).square().clamp(max=1)
        return (1 - near).square() * (15 / 16 / self.reach)  # the biweight kernel

    def half_length(self, meeting: Meeting) -> Float[Tensor, "p"]:
        return torch.full_like(meeting.distance, 8 / 15 * self.reach)

    def colours(
        self,
        index: Int[Tensor, "p"],
        meeting: Crossings,
        directions: Float[Tensor, "p 3"],  # type: ignore[override]
    ) -> Float[Tensor, "p 3"]:
        u, v = meeting.u, meeting.v
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
