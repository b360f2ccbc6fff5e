"""Poses that are right in themselves, but compared with true poses in another world."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.geometry import SE3, Similarity

LEAST = 3
"""Smallest number of poses for which a common transformation means anything: it has seven degrees of freedom."""
UNEXPLAINED = 0.1
"""Largest error, relative to the median error, that may remain in any pose after the transformation."""


def world_of_truth(found: SE3, true: SE3) -> Similarity | None:
    """Return the similarity that maps the world of the ``true`` poses to that of the ``found`` ones (n each).

    None unless it explains all errors. Its rotation is the mean of those between the orientations, so that the
    positions confirm it.
    """
    if len(found.translation) < LEAST:
        return None
    found, true = found.to(torch.float64), true.to(torch.float64)
    u, _, vh = torch.linalg.svd((found.rotation @ true.rotation.mT).sum(0))
    sign = torch.ones(3, dtype=u.dtype)
    sign[2] = torch.sign(torch.linalg.det(u @ vh))
    rotation = (u * sign) @ vh
    source, target = true.translation @ rotation.mT, found.translation
    from_mean, to_mean = source - source.mean(0), target - target.mean(0)
    scale = float((from_mean * to_mean).sum() / from_mean.square().sum())
    if not scale > 0:
        return None
    worlds = Similarity(scale, SE3(rotation, target.mean(0) - scale * source.mean(0)))
    left, error = _distances(worlds.apply(true.translation), target), _distances(true.translation, target)
    return worlds if bool(left.max() < UNEXPLAINED * error.median()) else None


def _distances(a: Float[Tensor, "n 3"], b: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    return torch.linalg.vector_norm(a - b, dim=-1)
