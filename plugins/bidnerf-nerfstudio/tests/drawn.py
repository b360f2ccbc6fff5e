"""Weights that a seed reproduces: of models of nerfstudio that are too large to be stored beside the tests."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

OCCUPIED = 0.3
"""Share of the cells of an occupancy grid that are occupied."""


def drawn(shapes: Mapping[str, Sequence[int]]) -> dict[str, Tensor]:
    """Return tensors of these shapes: of layers of usual size, of hash tables large, and of occupancy grids at random."""
    generator = torch.Generator().manual_seed(0)
    found: dict[str, Tensor] = {}
    for name, shape in sorted(shapes.items()):
        values = torch.randn(tuple(shape), generator=generator)
        if name.endswith("binaries"):
            found[name] = values > torch.distributions.Normal(0, 1).icdf(torch.tensor(1 - OCCUPIED))
        else:
            found[name] = values * (0.5 if "hash_table" in name else 1.5 / math.sqrt(shape[-1]))
    return found
