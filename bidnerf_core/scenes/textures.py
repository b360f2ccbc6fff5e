"""Textures for closed-form scenes: smooth functions of position, rich enough to distinguish one place from another.

All are practically band-limited, being plane waves with softened edges: an image of 100 to 200 pixels from a
typical distance shows them without aliasing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

Colour = tuple[float, float, float]
Vector = tuple[float, float, float]
Texture = Callable[[Tensor, Tensor], Tensor]
"""A function from points (n 3; metres, frame of the shape) and outward unit normals (n 3) to colours (n 3) in [0, 1]."""


@dataclass(frozen=True)
class Waves:
    """Two colours mixed by the product of plane waves (radians per metre), with a slow drift of the hue.

    One wave gives stripes, three give a chequered solid. The drift makes a pattern's periods differ from one another, so that
    a pose that is off by one period does not fit.
    """

    first: Colour
    second: Colour
    waves: tuple[Vector, ...]
    phases: tuple[float, ...]
    hardness: float  # slope of the edges: higher is sharper
    summed: bool = False  # instead of multiplied: irregular spots and veins

    def __call__(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        waves = _phase(points, self.waves, self.phases).sin_()
        level = waves.sum(0) / math.sqrt(len(self.waves)) if self.summed else waves.prod(0)
        weight = (0.5 + 0.5 * torch.tanh(self.hardness * level))[:, None]
        first, second = points.new_tensor(self.first), points.new_tensor(self.second)
        # The slow drift of red, green and blue has periods of about two metres.
        drift = ((2.3, 1.1, -1.7), (-1.3, 2.1, 1.9), (1.6, -1.9, 2.2))
        slow = _phase(points, drift, (self.phases[0], 1.0, 2.0)).sin_().T
        return (second + weight * (first - second) + 0.07 * slow).clamp_(0, 1)


@dataclass(frozen=True)
class Faces:
    """A texture for each side (+x, -x, +y, -y, +z, -z); a point gets the texture of the axis nearest to its normal."""

    sides: tuple[Texture, Texture, Texture, Texture, Texture, Texture]

    def __call__(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        axes = dominant_axis(normals)
        rgb = torch.empty_like(points)
        for i, texture in enumerate(self.sides):
            facing = normals[:, i // 2] > 0 if i % 2 == 0 else normals[:, i // 2] <= 0
            chosen = (axes[:, i // 2] & facing).nonzero()[:, 0]
            rgb[chosen] = texture(points[chosen], normals[chosen])
        return rgb


def checker(first: Colour, second: Colour, period: float | Vector, phase: float = 0.7) -> Waves:
    """Return soft cubes of alternating colour; ``period`` (metres) is twice the side of a cube, for all axes or per axis."""
    px, py, pz = period if isinstance(period, tuple) else (period,) * 3
    waves = ((2 * math.pi / px, 0.0, 0.0), (0.0, 2 * math.pi / py, 0.0), (0.0, 0.0, 2 * math.pi / pz))
    return Waves(first, second, waves, (phase, phase + 0.5, phase + 0.9), hardness=5.0)


def stripes(first: Colour, second: Colour, across: Vector, period: float, phase: float = 0.0) -> Waves:
    """Return soft bands that repeat every ``period`` metres in the direction ``across``."""
    length = math.hypot(*across)
    x, y, z = (2 * math.pi / period * a / length for a in across)
    return Waves(first, second, ((x, y, z),), (phase,), hardness=4.0)


def blotches(first: Colour, second: Colour, period: float, seed: int) -> Waves:
    """Return spots about half a ``period`` (metres) wide that do not visibly repeat."""
    generator = torch.Generator().manual_seed(seed)
    directions = torch.nn.functional.normalize(torch.randn((7, 3), generator=generator), dim=-1)
    lengths = 2 * math.pi / period * torch.linspace(0.7, 1.5, 7)[:, None]
    x = (directions * lengths).tolist()
    phases = (2 * math.pi * torch.rand(7, generator=generator)).tolist()
    return Waves(first, second, tuple((a, b, c) for a, b, c in x), tuple(phases), 3.0, summed=True)


def dominant_axis(vectors: Float[Tensor, "n 3"]) -> Bool[Tensor, "n 3"]:
    """Return a mask of the component of largest magnitude, the first of equal ones; ten times as fast as ``argmax``."""
    x, y, z = vectors.abs().unbind(-1)
    first = (x >= y) & (x >= z)
    second = ~first & (y >= z)
    return torch.stack([first, second, ~(first | second)], dim=-1)


def _phase(points: Tensor, waves: tuple[Vector, ...], phases: tuple[float, ...]) -> Tensor:
    """Return the phase of each wave at each point (k n; radians)."""
    return points.new_tensor(waves) @ points.T + points.new_tensor(phases)[:, None]
