"""Links between photos of a capture that show the same things, based on shared landmarks."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Int
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from bidnerf_core.mapping import TrackedKeypoints

LINK = 5
"""Number of shared landmarks from which two photos are linked. Photos of different places share one by
chance, seldom two: a match has to lie on the epipolar line, stand out from all others, and agree on a point
in front of both cameras.
"""
LEAST_GROUP = 3
"""Smallest number of linked photos that form a group."""


def linked(seen: TrackedKeypoints) -> csr_array:
    """Return the pairs of images that share enough landmarks, in both directions, as a sparse matrix (v, v).

    ``seen`` are the keypoints consistent with their points.
    """
    shape = (len(seen.images), max(1, seen.count))
    ones = np.ones(len(seen.point), np.int32)
    shows = csr_array((ones, (seen.image.numpy(), seen.point.numpy())), shape=shape)
    shared = (shows @ shows.T).tocoo()
    row, column = shared.coords
    enough = (shared.data >= LINK) & (row != column)
    links = np.ones(int(enough.sum()), bool), (row[enough], column[enough])
    return csr_array(links, shape=(len(seen.images),) * 2)


def groups(links: csr_array) -> Int[Tensor, "v"]:
    """Return the group of each image, 0 for the largest; -1 if too few images are linked to form one."""
    _, found = connected_components(links, directed=False)
    label = torch.from_numpy(found).long()
    sizes = torch.bincount(label)
    rank = sizes.argsort(descending=True, stable=True).argsort()
    return torch.where(sizes >= LEAST_GROUP, rank, -1)[label]
