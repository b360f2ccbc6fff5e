"""Where there is room for matter, as the training views leave it, and the sampler that asks only there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor, nn

from bidnerf_core.carving import occupied_cells
from bidnerf_core.field import Rays, RaySampler, RaySamples, SceneBounds
from bidnerf_core.frames import View


class Room(nn.Module):
    """A cube of cells around the scene, all of which may hold matter until ``carve`` says otherwise."""

    lower: Float[Tensor, "3"]
    cells: Bool[Tensor, "n n n"]

    def __init__(self, bounds: SceneBounds, resolution: int) -> None:
        super().__init__()
        self.resolution = resolution
        self.side = max(bounds.size)
        middle = [(a + b) / 2 for a, b in zip(bounds.lower, bounds.upper, strict=True)]
        self.register_buffer("lower", torch.tensor([m - self.side / 2 for m in middle]), persistent=False)
        self.register_buffer("cells", torch.ones((resolution,) * 3, dtype=torch.bool))

    def carve(self, views: Sequence[View], tolerance: float = 0.05) -> None:
        """Empty the cells that the views' silhouettes and measured depth see through.

        ``tolerance`` is the part by which measured depth may be off: a cell that is emptied by mistake is lost.
        """
        lower, upper = (tuple(corner.tolist()) for corner in (self.lower, self.lower + self.side))
        shape = (self.resolution,) * 3
        self.cells.copy_(occupied_cells(views, lower, upper, shape, tolerance))

    def holds(self, positions: Float[Tensor, "*p 3"]) -> Bool[Tensor, "*p"]:
        """Whether there may be matter at ``positions`` (metres, world); outside the cube its border tells."""
        scaled = (positions - self.lower.to(positions)) * (self.resolution / self.side)
        x, y, z = scaled.long().clamp_(0, self.resolution - 1).unbind(-1)
        return self.cells.view(-1)[(x * self.resolution + y) * self.resolution + z]


@dataclass(frozen=True)
class Within:
    """The samples of another sampler, valid only where there is room for matter."""

    room: Room
    sampler: RaySampler

    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        with torch.no_grad():
            samples = self.sampler(rays, jitter)
            return replace(samples, valid=samples.valid & self.room.holds(rays.at(samples.middles)))
