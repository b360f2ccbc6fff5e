"""Visual vocabularies, and the VLAD vectors into which they pool the descriptors of an image.

For each word of a vocabulary, a VLAD vector (Jegou et al. 2010, "Aggregating local descriptors into a compact image
representation") sums the residuals of the descriptors nearest to it, so an image becomes one vector whatever its number of
keypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import normalize

from bidnerf_core.mapping.landmarks.descriptors import k_means, nearest_centre


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Visual words, by which the descriptors of an image are pooled."""

    words: Float[Tensor, "w d"]

    @staticmethod
    def of(descriptors: Sequence[UInt8[Tensor, "n d"]], seed: int = 0) -> Vocabulary:
        """Build a vocabulary of at most 32 words from about 20,000 ``descriptors``, equally many from each map."""
        generator = torch.Generator().manual_seed(seed)
        share = -(-20_000 // len(descriptors))
        some = torch.cat([one[torch.randperm(len(one), generator=generator)[:share]] for one in descriptors])
        return Vocabulary(k_means(some, min(32, len(some)), generator))

    def pool(self, descriptors: UInt8[Tensor, "n d"]) -> Float[Tensor, "p"]:
        """Return the VLAD vector of descriptors, of unit length."""
        word = nearest_centre(descriptors, self.words)
        sums = torch.zeros_like(self.words).index_add_(0, word, descriptors.float() - self.words[word])
        roots = sums.sign() * sums.abs().sqrt()  # so that repeated structures do not dominate
        return normalize(normalize(roots, dim=1).flatten(), dim=0)
