"""Which photos are matched with each other: all of few; of many, neighbours in their order and those that look alike.

Neighbours are likely to overlap as photos and frames are taken one after another. Photos that look alike close loops, and
connect photos that are in no order. How alike two photos are is the product of their vectors of locally aggregated descriptors
(VLAD, Jégou et al. 2010), whose words are found in the photos themselves.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np

Pairs: TypeAlias = list[tuple[int, int]]
"""Pairs (i < j) of indices of photos."""

ALL_OF_PHOTOS, ALL_OF_FRAMES = 150, 60
"""Largest number of photos, and of a video's frames, of which all pairs are matched."""
NEIGHBOURS = 10
"""Photos on either side in the order of the names, or of time, with which each is matched."""
ALIKE = 20
"""Photos that look most alike with which each is matched."""
WORDS, SAMPLE = 64, 50_000
"""Number of words of the vocabulary, and of the descriptors from which it is made."""
ROUNDS = 10
"""Iterations of k-means."""
BLOCK = 1000
"""Photos that are compared with all others at a time."""


def all_pairs(count: int) -> Pairs:
    """Return every pair of ``count`` photos."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def few(count: int, ordered: bool) -> bool:
    """Return whether all pairs of so many photos are matched; ``ordered`` are frames of a video."""
    return count <= (ALL_OF_FRAMES if ordered else ALL_OF_PHOTOS)


def chosen_pairs(descriptors: Sequence[np.ndarray]) -> Pairs:
    """Return the pairs of photos, given the descriptors (n, 128) of each, that are neighbours or look alike."""
    count = len(descriptors)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(count, i + NEIGHBOURS + 1))}
    vectors = pooled(descriptors)
    for first in range(0, count, BLOCK):
        likeness = vectors[first : first + BLOCK] @ vectors.T
        rows = np.arange(len(likeness))
        likeness[rows, rows + first] = -np.inf
        best = np.argpartition(-likeness, min(ALIKE, count - 1) - 1, axis=1)[:, :ALIKE]
        pairs |= {
            (min(i, j), max(i, j)) for i, row in enumerate(best.tolist(), start=first) for j in row if i != j
        }
    return sorted(pairs)


def pooled(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Return one vector of unit length for the descriptors (n, 128) of each photo; zero where there are none."""
    words = _vocabulary(descriptors)
    return np.stack([_aggregated(own.astype(np.float32), words) for own in descriptors])


def _vocabulary(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    generator = np.random.default_rng(0)
    share = max(1, SAMPLE // max(1, len(descriptors)))
    parts = [own[generator.permutation(len(own))[:share]] for own in descriptors if len(own)]
    sample = np.concatenate(parts).astype(np.float32) if parts else np.zeros((1, 128), np.float32)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, ROUNDS, 0.0)
    cv2.setRNGSeed(0)
    _, _, words = cv2.kmeans(
        sample, min(WORDS, len(sample)), np.empty((0,), np.int32), criteria, 1, cv2.KMEANS_PP_CENTERS
    )
    return np.asarray(words)


def _aggregated(own: np.ndarray, words: np.ndarray) -> np.ndarray:
    total = np.zeros_like(words)
    if len(own):
        distance = (words**2).sum(1) - 2 * own @ words.T
        nearest = distance.argmin(1)
        np.add.at(total, nearest, own - words[nearest])
        total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)  # each word counts alike
    flat = total.reshape(-1)
    return flat / max(float(np.linalg.norm(flat)), 1e-9)
