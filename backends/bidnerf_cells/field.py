"""A radiance field of cells, each with a field of its own, and of an overview: one coarse field over all."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn
from torch.nn.functional import pad

from bidnerf_cells.config import CellsConfig
from bidnerf_core.backend import RadianceField, Rays, RaySampler, RaySamples, SceneBounds
from bidnerf_core.devices import constant, may_wait
from bidnerf_core.fields import FieldValues, intersect_box, levels

THIN = 1e-3
"""Density, per longest side of the scene, to which colours are blended as though there were matter everywhere."""


@dataclass(frozen=True)
class CellGrid:
    """Boxes of one size that divide the box of a scene. Those at its border go on without end."""

    bounds: SceneBounds
    counts: tuple[int, int, int]  # cells along x, y and z, of which z counts fastest
    overlap: float  # fraction of a cell's side in which two neighbours are blended, half of it on either side

    @staticmethod
    def of(config: CellsConfig, bounds: SceneBounds) -> CellGrid:
        """Return about cubic cells, of which ``config.cells`` are as long as the scene's longest side."""
        x, y, z = (max(1, round(config.cells * size / bounds.side)) for size in bounds.size)
        return CellGrid(bounds, (x, y, z), config.overlap)

    def box(self, number: int, margin: float, endless: bool) -> tuple[list[float], list[float]]:
        """Return the corners of a cell (metres), whose inner borders are moved outwards by ``margin`` sides of a cell.

        Where it is ``endless``, those on the scene's border are infinitely far away.
        """
        _, rows, layers = self.counts
        place = number // (rows * layers), number // layers % rows, number % layers
        corners: tuple[list[float], list[float]] = [], []
        for axis, (at, count) in enumerate(zip(place, self.counts, strict=True)):
            side = self.bounds.size[axis] / count
            for corner, border, sign in zip(corners, (at, at + 1), (-1, 1), strict=True):
                inner = 0 < border < count
                outside = sign * float("inf") if endless and not inner else 0.0
                corner.append(self.bounds.lower[axis] + side * (border + sign * margin * inner) + outside)
        return corners

    def bounds_of(self, number: int) -> SceneBounds:
        """Return the bounds of a cell's field, which include the zones in which it is blended with its neighbours."""
        (ax, ay, az), (bx, by, bz) = self.box(number, self.overlap / 2, endless=False)
        return replace(self.bounds, lower=(ax, ay, az), upper=(bx, by, bz))

    def weights(self, points: Float[Tensor, "p 3"]) -> Float[Tensor, "p cells"]:
        """Return the share of each cell in each point (metres, world). The shares add up to 1, and have continuous derivatives."""
        product = torch.ones_like(points[:, :1])
        for axis, count in enumerate(self.counts):
            place = (points[:, axis] - self.bounds.lower[axis]) * (count / self.bounds.size[axis])
            border = constant(tuple(float(number) for number in range(1, count)), points)
            ramp = ((place[:, None] - border) / self.overlap + 0.5).clamp(0, 1)
            beyond = pad(ramp * ramp * (3 - 2 * ramp), (1, 1))  # share of all cells behind each border
            beyond = beyond + constant((1.0, *[0.0] * count), points)
            product = (product[:, :, None] * (beyond[:, :-1] - beyond[:, 1:])[:, None]).flatten(1)
        return product


class CellsField(nn.Module):
    """Fields of another backend, one for each cell of a scene, that together are one field.

    A point is seen in the field of its cell; near a border, those on both sides are blended. Cells that are not trained yet show
    the ``overview``, a field over all.
    """

    trained: Bool[Tensor, "cells"]

    def __init__(self, config: CellsConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.bounds = bounds
        self.grid = CellGrid.of(config, bounds)
        x, y, z = self.grid.counts
        settings, build = config.settings_of(1), config.backend.build
        self.overview: Any = build(settings, bounds)
        cells: Any = (build(settings, self.grid.bounds_of(number)) for number in range(x * y * z))
        self.cells: Any = nn.ModuleList(cells)
        self.register_buffer("trained", torch.zeros(len(self.cells), dtype=torch.bool))

    @property
    def sampler(self) -> RaySampler:
        """The sampler of each ray in each cell that it crosses."""
        return CellSampler(self)

    @property
    def levels(self) -> tuple[RadianceField, RadianceField]:
        """The coarsest level of the overview, and this field."""
        return levels(self.overview)[0], self

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        """Return the densities of the cells, weighted by their shares in each point, and the colour of what is there."""
        points, along = positions.reshape(-1, 3), directions.reshape(-1, 3)
        shares = self.grid.weights(points)
        own = torch.where(self.trained, shares, 0)
        shares = torch.cat([own, (shares - own).sum(-1, keepdim=True)], dim=-1)
        thin = THIN / self.bounds.side
        density, light = torch.zeros_like(shares[:, 0]), torch.zeros_like(points)
        for share, field in zip(shares.unbind(-1), (*self.cells, self.overview), strict=True):
            index = rows(share > 0)
            if len(index):
                values = field.query(points.index_select(0, index), along.index_select(0, index))
                share = share.index_select(0, index)
                density = density.index_add(0, index, share * values.density)
                light = light.index_add(0, index, (share * (values.density + thin))[:, None] * values.rgb)
        rgb = (light / (density + thin)[:, None]).clamp(max=1)
        return FieldValues(density.reshape(positions.shape[:-1]), rgb.reshape(positions.shape))


@dataclass(frozen=True)
class CellSampler:
    """Samples each part of a ray with the sampler of the cell in which it lies, or of the overview where that is not trained."""

    field: CellsField

    @torch.no_grad()
    def __call__(self, rays: Rays, jitter: Generator | None = None) -> RaySamples:
        flat, field = rays.flattened(), self.field
        boxes = [field.grid.box(number, 0.0, endless=True) for number in range(len(field.cells))]
        lower, upper = (
            constant(tuple(itertools.chain(*corners)), flat.near).view(-1, 3) for corners in zip(*boxes, strict=True)
        )
        enter, leave = intersect_box(flat.origins[:, None], flat.directions[:, None], lower, upper)
        near = torch.maximum(enter, flat.near[:, None])
        far = torch.minimum(leave, flat.far[:, None])
        crossed = far > near
        far = torch.maximum(near, far)
        most = sum(field.grid.counts) - 2  # cells that a line crosses
        order = torch.where(crossed, near, torch.inf).argsort(dim=-1).argsort(dim=-1)
        parts = list[tuple[Tensor, Tensor, RaySamples]]()
        for number, cell in enumerate(field.cells):
            for own, active in ((cell, field.trained[number]), (field.overview, ~field.trained[number])):
                sampled = crossed[:, number] & active
                index = rows(sampled)
                if len(index):
                    place = torch.where(sampled, order[:, number], most).index_select(0, index)
                    limits = [limit[:, number].index_select(0, index) for limit in (near, far)]
                    lines = [line.index_select(0, index) for line in (flat.origins, flat.directions)]
                    parts.append((index, place, own.sampler(Rays(*lines, *limits), jitter)))
        width = max((samples.valid.shape[-1] for *_, samples in parts), default=0)
        shape = len(flat.near), most + 1, width  # what no cell needs goes to the last place
        last = flat.far[:, None, None]
        starts, ends, valid = last.repeat(1, *shape[1:]), last.repeat(1, *shape[1:]), crossed.new_zeros(shape)
        for index, place, samples in parts:
            for whole, part in zip((starts, ends, valid), samples.parts, strict=True):
                whole[index, place, : part.shape[-1]] = part
        return RaySamples(*(whole[:, :most].flatten(1) for whole in (starts, ends, valid))).unflattened(rays.near.shape)


def rows(wanted: Bool[Tensor, "n"]) -> Int[Tensor, "m"]:
    """Return the indices of the wanted rows or, if the host must not wait for their number, those of all."""
    return wanted.nonzero()[:, 0] if may_wait(wanted.device) else torch.arange(len(wanted), device=wanted.device)
