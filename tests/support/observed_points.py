"""Points in the image of a camera at a known pose, whose given intrinsics lack a known correction."""

from __future__ import annotations

import torch

from bidnerf_core import SE3
from bidnerf_core.mapping import GIVEN, Calibration, ObservedPoints

TRUE = SE3.exp(torch.tensor([0.3, -0.2, 0.1, 0.2, -0.1, 0.3], dtype=torch.float64))
FOCAL, HEIGHT = 400.0, 480.0


def observed(
    count: int = 200, calibration: Calibration = GIVEN, noise: float = 0.0, seed: int = 0
) -> ObservedPoints:
    """Points two to six metres before a camera whose given intrinsics lack ``calibration``."""
    random = torch.Generator().manual_seed(seed)
    flat = (torch.rand((count, 2), generator=random, dtype=torch.float64) - 0.5) * 1.2
    z = 2 + 4 * torch.rand((count, 1), generator=random, dtype=torch.float64)
    points = TRUE.apply(torch.cat([flat * z, z], dim=-1))
    pixels = calibration.pixels(flat, FOCAL)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=random, dtype=torch.float64)
    nothing = torch.zeros((count, 3), dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    focal = torch.full((count,), FOCAL, dtype=torch.float64)
    along = nothing + torch.tensor([0.0, 0.0, 1.0])
    return ObservedPoints(
        points, nothing[:, :2], along, pixels / FOCAL, focal, nothing[:, 0], eye, nothing, pixels[:, 1] / HEIGHT,
    )  # fmt: skip
