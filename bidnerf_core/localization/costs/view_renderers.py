"""Fast rendering of many rays, without derivatives, from the baked surface or from a field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.devices import constant
from bidnerf_core.fields.contract import RadianceField, SceneBounds
from bidnerf_core.fields.rendering import render
from bidnerf_core.mapping import SurfaceMap
from bidnerf_core.mapping.surface.casting import cast

CHUNK = 16384
"""Number of rays that are rendered at a time."""


@dataclass(frozen=True, eq=False)
class RayColours:
    """The rendered colour and distance of rays."""

    rgb: Float[Tensor, "r 3"]  # times ``known``, where that is less than 1
    known: Float[Tensor, "r"]  # 0 where the map has nothing along the ray
    # Metres to what is seen or, where that is the background, to where the ray passes closest to the scene.
    along: Float[Tensor, "r"]


@runtime_checkable
class ViewRenderer(Protocol):
    """Renders half-lines with unit directions (world frame)."""

    @property
    def device(self) -> torch.device:
        """Device on which the rays must lie and their colours are returned."""
        ...

    def __call__(self, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"]) -> RayColours: ...


@dataclass(frozen=True, eq=False)
class SurfaceRenderer:
    """Renders the colours of surfels and, where the scene has a background, its colour behind them."""

    surface: SurfaceMap
    background: (
        tuple[float, float, float] | None
    )  # None: a ray that meets nothing looks through a hole in the map

    @property
    def device(self) -> torch.device:
        return self.surface.device

    def __call__(self, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"]) -> RayColours:
        found = cast(self.surface, origins, directions)
        met = found.met[:, None].to(origins)
        behind = constant(self.background or (0.0, 0.0, 0.0), origins)
        rgb = met * self.surface.surfels.rgb[found.index] + (1 - met) * behind
        known = met[:, 0] if self.background is None else torch.ones_like(found.along)
        return RayColours(rgb, known, found.along.clamp(min=self.surface.cell))


@dataclass(frozen=True, eq=False)
class FieldRenderer:
    """Renders a field, with its background."""

    field: RadianceField
    bounds: SceneBounds
    device: torch.device

    @torch.no_grad()
    def __call__(self, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"]) -> RayColours:
        lower, upper = (constant(corner, origins) for corner in (self.bounds.lower, self.bounds.upper))
        middle = (lower + upper) / 2
        passing = ((middle - origins) * directions).sum(-1)
        parts = [
            self._rendered(*some) for some in zip(origins.split(CHUNK), directions.split(CHUNK), strict=True)
        ]
        rgb, along, opacity = (torch.cat(values) for values in zip(*parts, strict=True))
        along = torch.where(opacity > 0.5, along / opacity.clamp(min=0.5), passing)
        return RayColours(rgb, torch.ones_like(along), along.clamp(min=self.bounds.near))

    def _rendered(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        seen = render(self.field, self.bounds.rays(origins, directions), self.bounds.background)
        return seen.rgb, seen.distance, seen.opacity
