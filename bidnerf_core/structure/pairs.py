"""Selection of the pairs of photos to match: all pairs if there are few photos, else neighbours in order and similar photos.

Neighbours are likely to overlap since photos and frames are taken one after another. Similar photos close
loops, and connect photos in arbitrary order. The similarity of two photos is the product of their vectors of
locally aggregated descriptors (VLAD, Jégou et al. 2010), whose words are found in the photos themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
import torch

from bidnerf_core.mapping import Vocabulary

Pairs: TypeAlias = list[tuple[int, int]]
"""Pairs (i < j) of indices of photos."""

ALL_OF_PHOTOS, ALL_OF_FRAMES = 150, 60
"""Largest number of photos, and of video frames, for which all pairs are matched."""
NEIGHBOURS = 10
"""Number of photos on either side, in order of name or time, with which each is matched."""


def few(count: int, ordered: bool) -> bool:
    """Return whether all pairs of this many photos are matched; ``ordered`` are frames of a video."""
    return count <= (ALL_OF_FRAMES if ordered else ALL_OF_PHOTOS)


def chosen_pairs(descriptors: Sequence[np.ndarray]) -> Pairs:
    """Return the pairs of photos that are neighbours or among the twenty most similar, given the descriptors (n, 128) of each."""
    count, known = len(descriptors), [torch.from_numpy(own) for own in descriptors]
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + NEIGHBOURS + 1))}
    vocabulary = Vocabulary.of([own for own in known if len(own)] or [torch.zeros((1, 1), dtype=torch.uint8)])
    zero = torch.zeros(vocabulary.words.numel())  # for photos without keypoints
    vectors = torch.stack([vocabulary.pooled(own) if len(own) else zero for own in known]).numpy()
    for first in range(0, count, 1000):  # photos compared with all others at a time
        likeness = vectors[first : first + 1000] @ vectors.T
        rows = np.arange(len(likeness))
        likeness[rows, rows + first] = -np.inf
        best = np.argpartition(-likeness, min(20, count - 1) - 1, axis=1)[:, :20]
        pairs |= {
            (min(i, j), max(i, j)) for i, row in enumerate(best.tolist(), start=first) for j in row if i != j
        }
    return sorted(pairs)
