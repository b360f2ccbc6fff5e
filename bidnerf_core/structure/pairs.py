"""Selection of the pairs of photos to match: all pairs if there are few photos, else neighbours in order and similar
photos.

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
ALIKE = 20
"""Number of most similar photos with which each is matched."""
BLOCK = 1000
"""Number of photos compared with all others at a time."""


def all_pairs(count: int) -> Pairs:
    """Return every pair of ``count`` photos."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def few(count: int, ordered: bool) -> bool:
    """Return whether all pairs of this many photos are matched; ``ordered`` are frames of a video."""
    return count <= (ALL_OF_FRAMES if ordered else ALL_OF_PHOTOS)


def chosen_pairs(descriptors: Sequence[np.ndarray]) -> Pairs:
    """Return the pairs of photos that are neighbours or look similar, given the descriptors (n, 128) of each photo."""
    count = len(descriptors)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + NEIGHBOURS + 1))}
    vectors = _pooled(descriptors)
    for first in range(0, count, BLOCK):
        likeness = vectors[first : first + BLOCK] @ vectors.T
        rows = np.arange(len(likeness))
        likeness[rows, rows + first] = -np.inf
        best = np.argpartition(-likeness, min(ALIKE, count - 1) - 1, axis=1)[:, :ALIKE]
        pairs |= {
            (min(i, j), max(i, j)) for i, row in enumerate(best.tolist(), start=first) for j in row if i != j
        }
    return sorted(pairs)


def _pooled(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Return one unit vector for the descriptors (n, d) of each photo; zero if there are none."""
    found = [torch.from_numpy(own) for own in descriptors]
    vocabulary = Vocabulary.of([own for own in found if len(own)] or [torch.zeros((1, 1), dtype=torch.uint8)])
    zero = torch.zeros(vocabulary.words.numel())
    return torch.stack([vocabulary.pooled(own) if len(own) else zero for own in found]).numpy()
