"""Settings of an AdaNeRF: its size, its sparsity and its training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from bidnerf_core.errors import InputError
from bidnerf_core.settings import Count, NotNegative, Range
from bidnerf_core.training import SupervisionConfig


@dataclass(frozen=True)
class AdaNerfConfig(SupervisionConfig):
    """Settings of an AdaNeRF. With the defaults, training takes about ten minutes on one core of a small CPU."""

    # The shading network.
    width: Count = 128  # of the hidden layers
    layers: Count = 4
    position_frequencies: Annotated[int, Range(0, 64)] = 8
    direction_frequencies: Annotated[int, Range(0, 64)] = 2
    # The sampling network, here called the oracle.
    oracle_width: Count = 256
    oracle_layers: Count = 3
    ray_points: Annotated[int, Range(2, 10**7)] = 16  # points that describe a ray to the oracle
    ray_frequencies: Annotated[int, Range(0, 64)] = 3  # of the encoding of each of them
    # How many samples a ray takes. The last two may be changed in a trained map. Fewer samples are faster, but the holes
    # where bins are missed lead a pose astray long before they are visible.
    bins: Count = 64  # equal parts of a ray's segment in the scene's box, each with a score
    threshold: NotNegative = 0.03  # a bin is shaded if its score is above this ...
    max_samples: Count = 16  # ... and among so many highest scores of its ray
    # Training.
    steps: Count = 4500
    dense_part: Annotated[float, Range(0, 1)] = 0.4  # of the steps: all bins are shaded and count
    soft_part: Annotated[float, Range(0, 1)] = 0.2  # of the steps, next: bins are weighted by their scores
    samples_per_step: Count = 8192  # it decides the number of rays
    rays_at_most: Count = 4096  # per step
    learning_rate: NotNegative = 3e-3
    sparsity_weight: NotNegative = 0.01  # of the mean score, once the soft phase is half over
    # of the oracle's own loss, with measured depth and shaded bins as targets
    oracle_weight: NotNegative = 0.1
    empty_weight: NotNegative = 0.1  # of the opacity of bins that are known to be empty
    carve: bool = True  # in training, treat bins as empty where depth and silhouettes leave no matter
    # cells along the scene's longest side, for ``carve``
    room_resolution: Annotated[int, Range(2, 1024)] = 64
    seed: Annotated[int, Range(0)] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.dense_part + self.soft_part <= 1:
            parts = self.dense_part + self.soft_part
            raise InputError(f"dense_part and soft_part make {parts:g}, expected 1 or less together")

    @classmethod
    def paper(cls) -> AdaNerfConfig:
        """Return the sizes of the paper: two networks of 8 layers of width 256, and 128 bins."""
        return cls(
            width=256, layers=8, position_frequencies=10, direction_frequencies=4, oracle_width=256, oracle_layers=8,
            bins=128, steps=300_000, samples_per_step=2048 * 128, rays_at_most=2048, learning_rate=5e-4, carve=False,
        )  # fmt: skip
