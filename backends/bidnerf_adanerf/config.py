"""Settings of an AdaNeRF: its size, its sparsity and its training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bidnerf_core.errors import InputError
from bidnerf_core.settings import Count, Layers, NotNegative, Positive, Range
from bidnerf_core.training import SupervisionConfig


@dataclass(frozen=True)
class AdaNerfConfig(SupervisionConfig):
    """Settings of an AdaNeRF. With the defaults, training takes about ten minutes on one core of a small CPU."""

    # The shading network.
    width: Count = 128  # units of a hidden layer of the shading network
    layers: Layers = 4  # hidden layers of the shading network before the density
    position_frequencies: Annotated[int, Range(0, 64)] = 8  # octaves of sines and cosines of the position
    direction_frequencies: Annotated[int, Range(0, 64)] = 2  # octaves of sines and cosines of the direction
    # The sampling network, here called the oracle.
    oracle_width: Count = 256  # units of a hidden layer of the oracle, the network that chooses samples
    oracle_layers: Layers = 3  # hidden layers of the oracle
    ray_points: Annotated[int, Range(2, 10**7)] = 16  # points that describe a ray to the oracle
    ray_frequencies: Annotated[int, Range(0, 64)] = 3  # octaves of sines and cosines of each of these points
    # Number of samples per ray. The last two may be changed in a trained map. Fewer samples are faster, but
    # missed bins leave holes, which mislead pose estimation long before they are visible.
    bins: Count = 64  # number of equal parts of a ray's segment in the scene's box, each with a score
    threshold: NotNegative = 0.03  # score above which a bin is shaded
    max_samples: Count = 16  # maximum number of bins shaded along a ray: those of the highest scores
    # Training.
    steps: Count = 4500  # steps of the optimizer
    # fraction of the steps that shade all bins alike, at first
    dense_part: Annotated[float, Range(0, 1)] = 0.4
    # fraction of the steps, after these, that weight bins by their scores
    soft_part: Annotated[float, Range(0, 1)] = 0.2
    # approximate number of samples shaded per step, which determines the number of rays
    samples_per_step: Count = 8192
    rays_at_most: Count = 4096  # maximum number of rays per step
    learning_rate: Positive = 3e-3  # initial learning rate
    sparsity_weight: NotNegative = 0.01  # weight of the mean score, once the soft phase is half over
    # weight of the oracle's own loss, whose targets are measured depth and shaded bins
    oracle_weight: NotNegative = 0.1
    empty_weight: NotNegative = 0.1  # weight of the opacity of bins that are known to be empty
    carve: bool = True  # treat bins as empty in training where depth and silhouettes rule out matter
    # number of cells along the scene's longest side in the grid of empty space
    room_resolution: Annotated[int, Range(2, 1024)] = 64
    seed: Annotated[int, Range(0), "N"] = 0  # seed of the initial weights and of all random draws

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.dense_part + self.soft_part <= 1:
            parts = self.dense_part + self.soft_part
            raise InputError(f"dense_part and soft_part sum to {parts:g}", expected="at most 1")
