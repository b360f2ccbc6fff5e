"""Input encodings of radiance-field networks, and the conversion of their raw output to density."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from bidnerf_core.fields.contract import FieldValues, SceneBounds

Network: TypeAlias = Callable[
    [Float[Tensor, "p 3"], Float[Tensor, "p 3"]], tuple[Float[Tensor, "p"], Float[Tensor, "p 3"]]
]
"""A function that returns raw density and RGB in [0, 1] at points of the cube [-1, 1], seen along unit directions."""


def encoding_width(frequencies: int, include_input: bool = True) -> int:
    """Return the number of values in the frequency encoding of a point."""
    return 3 * (2 * frequencies + include_input)


def octaves(count: int, points: Tensor, lowest: float = torch.pi) -> Float[Tensor, "l"]:
    """Return ``count`` angular frequencies, each twice the previous one, in the dtype and on the device of ``points``."""
    return lowest * 2 ** torch.arange(count, dtype=points.dtype, device=points.device)


def frequency_encoding(
    points: Float[Tensor, "*p 3"],
    frequencies: Float[Tensor, "l"],
    include_input: bool = True,
    sines_first: bool = False,
) -> Float[Tensor, "*p f"]:
    """Return ``(p, sin(w_1 p), cos(w_1 p), ..., sin(w_L p), cos(w_L p))`` (Mildenhall et al. 2020, eq. 4).

    For coordinates in [-1, 1], ``octaves`` gives the paper's frequencies. The three sines of a frequency come before its three
    cosines or, with ``sines_first``, the sines of all frequencies before all cosines. ``p`` itself comes first if
    ``include_input`` is set.
    """
    angles = points[..., None, :] * frequencies[:, None]
    waves = torch.stack([angles.sin(), angles.cos()], dim=-3 if sines_first else -2).flatten(-3)
    return torch.cat([points, waves], dim=-1) if include_input else waves


def query_network(
    network: Network, bounds: SceneBounds, positions: Float[Tensor, "*p 3"], directions: Float[Tensor, "*p 3"]
) -> FieldValues:
    """Query a network at positions scaled to the cube [-1, 1], so that the unit of length has no effect."""
    shape = positions.shape[:-1]
    raw, rgb = network(bounds.normalized(positions.reshape(-1, 3)), directions.reshape(-1, 3))
    # The shift makes an untrained field nearly transparent (Barron et al. 2021, mip-NeRF). The density is 30 per side of the scene
    # at a raw density of about 1, so that networks with small outputs can represent surfaces.
    density = functional.softplus(raw - 1) * (30 / bounds.side)
    return FieldValues(density.reshape(shape), rgb.reshape(*shape, 3))


def spherical_harmonics(directions: Float[Tensor, "*p 3"], count: int) -> Float[Tensor, "*p k"]:
    """Return the first ``count`` (1, 4, 9 or 16) real spherical harmonics at unit directions, without the Condon-Shortley phase."""
    x, y, z = directions.unbind(-1)
    harmonics = [torch.full_like(x, 0.28209479177387814)]
    if count > 1:
        harmonics += [0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        harmonics += [
            1.0925484305920792 * x * y,
            1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * zz - 1),
            1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if count > 9:
        harmonics += [
            0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644658 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return torch.stack(harmonics, dim=-1)
