"""The field of AdaNeRF (Kurz et al. 2022): a shading network, evaluated at points that a sampling network chooses."""

from __future__ import annotations

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

    def query(self, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]) -> FieldValues:
        return query_network(self.shading, self.bounds, positions, directions)
