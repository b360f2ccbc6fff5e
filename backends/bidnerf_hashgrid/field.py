"""The radiance field of Instant-NGP (Mueller et al. 2022, section 5.4): hash encoding, two small MLPs, occupancy grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Annotated, Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from bidnerf_core.errors import InputError
from bidnerf_core.fields import (
    FieldDerivatives,
    FieldValues,
    RaySampler,
    SceneBounds,
    backward_derivatives,
    spherical_harmonics,
)
from bidnerf_core.settings import Count, Layers, NotNegative, Range, Settings
from bidnerf_hashgrid import fused
from bidnerf_hashgrid.encoding import HashEncoding, HashEncodingConfig
from bidnerf_hashgrid.networks import log_density_and_rgb
from bidnerf_hashgrid.occupancy import ConcentratedInGrid, GridDensity, OccupancyGrid

LARGEST_LOG_DENSITY = 12.0


@dataclass(frozen=True)
class FieldConfig(Settings):
    """Size of the field."""

    encoding: HashEncodingConfig = field(
        default_factory=lambda: HashEncodingConfig(levels=10, log2_table_size=18, finest_resolution=1024)
    )
    # cells of the finest level per pixel footprint; limited by `finest_resolution`, which is used alone if this
    # is 0
    cells_per_pixel: NotNegative = 2.5
    width: Count = 64  # units of a hidden layer
    colour_layers: Layers = 2  # hidden layers of the colour network
    # number of features that the density network passes on to the colour network
    geometry_features: Count = 15
    # cells of the occupancy grid along the longest side of the scene
    grid_resolution: Annotated[int, Range(2, 1024)] = 128
    # maximum number of intervals along a ray; with 0, all those in occupied cells
    samples_per_ray: Annotated[int, Range(0)] = 32
    coarse_levels: Annotated[int, Range(0)] = 4  # levels of the encoding that the coarse field keeps

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.coarse_levels > self.encoding.levels:
            raise InputError(
                f"coarse_levels is {self.coarse_levels}",
                expected=f"{self.encoding.levels} (levels of the encoding) or less",
            )


class HashGridField(nn.Module):
    """Density and colour in a scene's box. Its ``levels`` are the field with its fine encoding levels masked, and the full field."""

    def __init__(self, config: FieldConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.config = config
        self.bounds = bounds
        self.side = max(bounds.size)
        self.encoding = HashEncoding(_encoding_config(config, bounds))
        self.geometry = nn.Sequential(
            nn.Linear(self.encoding.width, config.width),
            nn.ReLU(),
            nn.Linear(config.width, 1 + config.geometry_features),
        )
        self.colour = nn.Sequential(
            *_hidden([config.geometry_features + 9, *[config.width] * config.colour_layers]),
            nn.Linear(config.width, 3),
            nn.Sigmoid(),
        )
        # In a contracted scene, the samples of most rays are concentrated by the density of whole cells,
        # within which shorter steps would give no more information.
        single = bounds.contracted and config.samples_per_ray > 0
        self.occupancy = OccupancyGrid(bounds, config.grid_resolution, steps_per_cell=1 if single else 2)
        self.coarse_sampler = OccupancyGrid(bounds, config.grid_resolution // 2)
        self._packed: tuple[Any, fused.PackedNetworks | None] | None = None  # with the weights' versions

    @property
    def sampler(self) -> RaySampler:
        return limit_samples(self.occupancy, self.config.samples_per_ray)

    @property
    def levels(self) -> tuple[CoarseField, HashGridField]:
        return CoarseField(self), self

    def upgraded_state(self, state: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return a stored state unchanged. Raises ``InputError`` if it holds densities that are not finite."""
        for name in ("occupancy.density", "coarse_sampler.density"):
            if name in state and not bool(state[name].isfinite().all()):
                raise InputError(f"tensor '{name}' holds infinity", expected="densities")
        return state

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return self.query_levels(positions, directions, None)

    def jacobian(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"], wanted: Bool[Tensor, "p"] | None = None
    ) -> FieldDerivatives:
        return self.jacobian_of_levels(positions, directions, wanted, None)

    def query_levels(
        self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"], active: int | None
    ) -> FieldValues:
        """Return density and colour as computed from the first ``active`` levels of the encoding (None: all)."""
        shape = positions.shape[:-1]
        points, along = positions.reshape(-1, 3), directions.reshape(-1, 3)
        moving = torch.is_grad_enabled() and (points.requires_grad or along.requires_grad)
        if (kernel := None if moving else self._kernel(active)) is not None:
            density, rgb = fused.query(points, along, False, None, *kernel)[0].split((1, 3), -1)
        else:
            values = self.values_of(self.encode(points, active), along)
            density, rgb = values.density, values.rgb
        return FieldValues(density.reshape(shape), rgb.reshape(*shape, 3))

    def values_of(self, encoded: Float[Tensor, "p f"], directions: Float[Tensor, "p 3"]) -> FieldValues:
        """Return density and colour at encoded positions, seen along unit directions."""
        harmonics = spherical_harmonics(directions, 9)
        log_density, rgb = log_density_and_rgb(self.geometry, self.colour, encoded, harmonics)
        return FieldValues(self._density(log_density), rgb)

    @torch.no_grad()
    def density_of(self, encoded: Float[Tensor, "p f"]) -> Float[Tensor, "p"]:
        """Return the density alone at encoded positions, without recording gradients."""
        first, _, last = cast(Sequence[Any], self.geometry)
        hidden = torch.addmm(first.bias, encoded, first.weight.t()).relu_()
        return self._density(torch.addmv(last.bias[:1], hidden, last.weight[0]))

    def _density(self, log_density: Float[Tensor, "p"]) -> Float[Tensor, "p"]:
        # Per side of the scene, so that an untrained field is equally thin in any unit of length.
        return log_density.clamp(max=LARGEST_LOG_DENSITY).exp() / self.side

    def jacobian_of_levels(
        self,
        positions: Float[Tensor, "p 3"],
        directions: Float[Tensor, "p 3"],
        wanted: Bool[Tensor, "p"] | None,
        active: int | None,
    ) -> FieldDerivatives:
        """Return the values of ``query_levels`` and their derivatives by position and direction.

        Where a kernel is used, all of these are 0 at points that are not ``wanted``.
        """
        with torch.no_grad():
            kernel = self._kernel(active)
            if kernel is None:
                return backward_derivatives(partial(self.query_levels, active=active), positions, directions)
            values, by_both = fused.query(positions, directions, True, wanted, *kernel)
        return FieldDerivatives(FieldValues(values[:, 0], values[:, 1:]), *by_both.split(3, -1))

    def _kernel(self, active: int | None) -> tuple[Any, ...] | None:
        """Return the arguments of ``fused.query`` if a kernel can compute the field; the kernel gives no gradients of the parameters."""
        encoding = self.encoding
        levels = encoding.levels[:active]
        if not (levels and fused.fits(list(encoding.tables))):
            return None
        if torch.is_grad_enabled() and any(part.requires_grad for part in self.parameters()):
            return None
        parts = [*self.geometry.parameters(), *self.colour.parameters()]
        version = [(part.data_ptr(), part._version) for part in parts]
        if self._packed is None or self._packed[0] != version:
            self._packed = version, fused.PackedNetworks.of(self.geometry, self.colour)
        packed = self._packed[1]
        smooth, limits = encoding.config.interpolation == "smooth", (self.bounds, LARGEST_LOG_DENSITY)
        if packed is None:
            return None
        return packed, levels, list(encoding.tables)[: len(levels)], smooth, limits

    def encode(self, positions: Float[Tensor, "p 3"], active: int | None) -> Float[Tensor, "p f"]:
        encoded: Tensor = self.encoding((self.bounds.normalized(positions) + 1) / 2, active)
        return encoded


def _encoding_config(config: FieldConfig, bounds: SceneBounds) -> HashEncodingConfig:
    """Return an encoding as fine as the images: finer levels would only cause collisions in their tables."""
    encoding = config.encoding
    finest = encoding.finest_resolution
    if config.cells_per_pixel > 0 and bounds.footprint > 0:
        wanted = config.cells_per_pixel * bounds.side / bounds.footprint
        finest = max(encoding.base_resolution, min(finest, wanted))
    # The box is only the middle half of a contracted cube.
    return replace(encoding, finest_resolution=finest * (2 if bounds.contracted else 1))


def _hidden(widths: Sequence[int]) -> list[nn.Module]:
    return [part for a, b in pairwise(widths) for part in (nn.Linear(a, b), nn.ReLU())]


def limit_samples(grid: OccupancyGrid, count: int) -> RaySampler:
    """Return a sampler of at most ``count`` intervals per ray, concentrated where the grid has observed density.

    If the count is 0, or the grid has observed nothing, the sampler is the grid itself, which samples all occupied cells.
    """
    return ConcentratedInGrid(GridDensity(grid), count) if count and grid.observed else grid


@dataclass(frozen=True)
class CoarseField:
    """A hash-grid field with its coarse encoding levels only: blurred and cheaper, with gradients that reach farther."""

    fine: HashGridField

    @property
    def sampler(self) -> RaySampler:
        return limit_samples(self.fine.coarse_sampler, self.fine.config.samples_per_ray)

    @property
    def occupancy(self) -> OccupancyGrid:
        return self.fine.coarse_sampler

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return self.fine.query_levels(positions, directions, self.fine.config.coarse_levels)

    def jacobian(
        self, positions: Float[Tensor, "p 3"], directions: Float[Tensor, "p 3"], wanted: Bool[Tensor, "p"] | None = None
    ) -> FieldDerivatives:
        return self.fine.jacobian_of_levels(positions, directions, wanted, self.fine.config.coarse_levels)
