"""The field of AdaNeRF (Kurz et al. 2022): a shading network that is evaluated where a sampling network chooses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, nn

from bidnerf_adanerf.bins import Bins, Sparse
from bidnerf_adanerf.config import AdaNerfConfig
from bidnerf_adanerf.networks import Oracle, ShadingNetwork
from bidnerf_core.fields import FieldValues, SceneBounds, query_network


class AdaNerfField(nn.Module):
    """Density and colour in a scene's box, with a ``sampler`` that chooses the few points of a ray that matter.

    There are no coarser ``levels``: the shading network is trained at the oracle's samples, at one level of detail.
    """

    def __init__(self, config: AdaNerfConfig, bounds: SceneBounds) -> None:
        super().__init__()
        self.config = config
        self.bounds = bounds
        self.side = bounds.side
        self.shading = ShadingNetwork(
            config.width, config.layers, config.position_frequencies, config.direction_frequencies
        )
        self.oracle = Oracle(
            config.oracle_width, config.oracle_layers, config.ray_points, config.ray_frequencies, config.bins
        )

    @property
    def bins(self) -> Bins:
        return Bins(self.bounds, self.config.bins)

    @property
    def sampler(self) -> Sparse:
        return Sparse(self.oracle, self.bins, self.config.threshold, self.config.max_samples)

    @property
    def dense(self) -> DenseField:
        return DenseField(self)

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return query_network(self.shading, self.bounds, positions, directions)


@dataclass(frozen=True)
class DenseField:
    """The field with all bins shaded, without the oracle: the sparse field is trained to reproduce its rendering."""

    sparse: AdaNerfField

    def parameters(self) -> Iterator[nn.Parameter]:
        return self.sparse.parameters()

    @property
    def sampler(self) -> Bins:
        return self.sparse.bins

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return self.sparse.query(positions, directions)
