"""Settings of an AdaNeRF: its size, its sparsity and its training."""

from __future__ import annotations

from dataclasses import dataclass

from bidnerf_core.errors import InputError

LEAST = {
    "width": 1, "layers": 1, "position_frequencies": 0, "direction_frequencies": 0, "oracle_width": 1,
    "oracle_layers": 1, "ray_points": 2, "ray_frequencies": 0, "bins": 1, "max_samples": 1, "threshold": 0, "steps": 1,
    "samples_per_step": 1, "rays_at_most": 1, "learning_rate": 0, "depth_weight": 0, "sparsity_weight": 0,
    "oracle_weight": 0, "empty_weight": 0, "dense_part": 0, "soft_part": 0, "room_resolution": 2, "seed": 0,
}  # fmt: skip


@dataclass(frozen=True)
class AdaNerfConfig:
    """Settings of an AdaNeRF. With the defaults, training takes about ten minutes on one core of a small CPU."""

    # The shading network.
    width: int = 128  # of the hidden layers
    layers: int = 4
    position_frequencies: int = 8
    direction_frequencies: int = 2
    # The sampling network, here called the oracle.
    oracle_width: int = 256
    oracle_layers: int = 3
    ray_points: int = 16  # points that describe a ray to the oracle
    ray_frequencies: int = 3  # of the encoding of each of them
    # How many samples a ray takes. The last two may be changed in a trained map. Fewer samples are faster, but the holes
    # where bins are missed lead a pose astray long before they are visible.
    bins: int = 64  # equal parts of a ray's segment in the scene's box, each with a score
    threshold: float = 0.03  # a bin is shaded if its score is above this ...
    max_samples: int = 16  # ... and among so many highest scores of its ray
    # Training.
    steps: int = 4500
    dense_part: float = 0.4  # of the steps: all bins are shaded and count
    soft_part: float = 0.2  # of the steps, after those: bins are weighted by their scores; the remaining steps shade sparsely
    samples_per_step: int = 8192  # it decides the number of rays
    rays_at_most: int = 4096  # per step
    learning_rate: float = 3e-3
    depth_weight: float = 0.1
    sparsity_weight: float = 0.01  # of the mean score, once the soft phase is half over
    oracle_weight: float = (
        0.1  # of the oracle's own loss, which has measured depth and the shaded bins as targets
    )
    empty_weight: float = 0.1  # of the opacity of bins that are known to be empty
    carve: bool = (
        True  # in training, treat bins as empty where the views' depth and silhouettes leave no matter
    )
    room_resolution: int = 64  # cells along the longest side of the scene, for ``carve``
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in LEAST.items():
            value = getattr(self, name)
            if not value >= least:
                raise InputError(f"{name} is {value}, expected {least} or more")
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
