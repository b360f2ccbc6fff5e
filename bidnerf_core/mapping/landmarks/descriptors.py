"""Descriptors of keypoints as bytes, the distances between them, and the search for the nearest ones."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import pad

NORM = 512.0
"""Norm of a quantised descriptor, as usual for SIFT: it makes good use of the range of a byte."""
MANY = 2**16
"""Number of descriptors converted to floats at a time; converting all those of a large map at once would take gigabytes."""
RATIO = 0.8
"""Largest ratio of the distances to the nearest and the second-nearest descriptor of a match (Lowe 2004)."""
MATCHED_ROWS = 256
"""Number of descriptors whose distances to all of another image are computed at a time, which fit the processor's cache."""
BLOCK = 2**20
"""Number of distances to cell centres computed at a time, which bounds the memory."""


def quantize(descriptors: Float[Tensor, "n d"]) -> UInt8[Tensor, "n d"]:
    """Return unit descriptors as bytes; if any channel is negative, all channels are shifted, which preserves distances."""
    negative = len(descriptors) > 0 and float(descriptors.min()) < 0
    scaled = descriptors * (NORM / 2 if negative else NORM) + (128 if negative else 0)
    return scaled.round().clamp(0, 255).to(torch.uint8)


def unrelated_distance(descriptors: UInt8[Tensor, "n d"]) -> float:
    """Return the root mean square distance between unrelated descriptors, which is the scale of a detector's distances."""
    total, squares = torch.zeros(descriptors.shape[1], dtype=torch.float64), 0.0
    for part in descriptors.cpu().split(MANY):
        total += part.sum(0)
        squares += float(part.double().square().sum())
    count = max(1, len(descriptors))
    return math.sqrt(max(0.0, 2 * (squares / count - float((total / count).square().sum()))))


def byte_of_zero(parts: Iterable[UInt8[Tensor, "n d"]]) -> int:
    """Return the byte that represents 0 in descriptors of equal norm: 0 for SIFT, 128 for descriptors with negative channels.

    It is the centre of the sphere on which the descriptors lie: the byte ``z`` that minimizes the variance of the squared norms of
    ``descriptors - z``. The descriptors of several images, or parts of many, are added up in turn, as all would take gigabytes.
    """
    values = (part.float() for part in parts)
    # Sums of bytes and of their squares are exact up to 2^24.
    of_parts = ((part.sum(1).double(), part.square_().sum(1).double()) for part in values)
    sums, squares = map(torch.cat, zip(*of_parts, strict=True))
    if not len(sums) or float(sums.var(unbiased=False)) == 0:
        return 0
    slope = ((squares - squares.mean()) * (sums - sums.mean())).mean() / sums.var(unbiased=False)
    return round(min(255.0, max(0.0, float(slope) / 2)))


def squared_distances(
    a: UInt8[Tensor, "n d"] | Float[Tensor, "n d"], b: UInt8[Tensor, "m d"] | Float[Tensor, "m d"]
) -> Float[Tensor, "n m"]:
    """Return squared Euclidean distances between all pairs; exact for bytes, whose sums of squares fit a float32."""
    x, y = a.float(), b.float()
    return torch.addmm((x * x).sum(-1)[:, None] + (y * y).sum(-1), x, y.T, alpha=-2).clamp_(min=0)


def paired_squared_distances(
    a: UInt8[Tensor, "n d"], b: UInt8[Tensor, "m d"], rows: Int[Tensor, "p"], columns: Int[Tensor, "p"]
) -> Float[Tensor, "p"]:
    """Return the squared Euclidean distance of each pair ``a[rows]``, ``b[columns]``."""
    return (a[rows].float() - b[columns].float()).square_().sum(-1)


def mutual_nearest(distances: Float[Tensor, "n m"]) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
    """Return the row and the column of each finite distance that is the smallest of both its row and its column."""
    best, partner = distances.min(1)
    rows = ((distances.argmin(0)[partner] == torch.arange(len(partner))) & best.isfinite()).nonzero()[:, 0]
    return rows, partner[rows]


def unambiguous_nearest(a: UInt8[Tensor, "n d"], b: UInt8[Tensor, "m d"]) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
    """Return the rows of ``a`` whose nearest descriptor in ``b`` is far nearer than the second-nearest, and the rows of the nearest."""
    if len(b) < 2:
        return torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long)
    # Products with the squares of ``b`` as one more channel order each row as distances do. A block is overwritten by the next, since
    # allocating each anew takes longer than computing it.
    x, y = a.float(), b.float()
    products = torch.cat([-2 * x, torch.ones(len(x), 1)], dim=1)
    others = torch.cat([y, y.square().sum(-1, keepdim=True)], dim=1)
    block = torch.empty(min(MATCHED_ROWS, len(a)), len(b))
    best, second, nearest = torch.empty(len(a)), torch.empty(len(a)), torch.empty(len(a), dtype=torch.long)
    for rows in torch.arange(len(a)).split(MATCHED_ROWS):
        values = torch.mm(products[rows], others.T, out=block[: len(rows)])
        best[rows], nearest[rows] = values.min(1)
        second[rows] = values.scatter_(1, nearest[rows, None], torch.inf).amin(1)
    squares = x.square().sum(-1)
    rows = (best + squares < RATIO**2 * (second + squares)).nonzero()[:, 0]
    return rows, nearest[rows]


def mutual_matches(a: UInt8[Tensor, "n d"], b: UInt8[Tensor, "m d"]) -> tuple[Int[Tensor, "p"], Int[Tensor, "p"]]:
    """Return the rows of descriptors that are each other's nearest, and far nearer than the second-nearest of both."""
    rows, partner = unambiguous_nearest(a, b)
    numbers, returned = unambiguous_nearest(b[partner], a)
    is_mutual = returned == rows[numbers]
    return rows[numbers[is_mutual]], partner[numbers[is_mutual]]


def k_means(descriptors: UInt8[Tensor, "n d"], count: int, generator: torch.Generator) -> Float[Tensor, "c d"]:
    """Return the centres of k-means clusters (Lloyd 1982) of a sample of twenty descriptors per cluster.

    A cluster that becomes empty keeps its centre.
    """
    sample = torch.randperm(len(descriptors), generator=generator)[: 20 * count]
    values = descriptors[sample.to(descriptors.device)].float()
    centres = values[:count].clone()
    for _ in range(6):  # the cells need to be balanced, not optimal
        cell = nearest_centre(values, centres)
        sizes = torch.bincount(cell, minlength=count)
        total = torch.zeros_like(centres).index_add_(0, cell, values)
        centres = torch.where(sizes[:, None] > 0, total / sizes.clamp(min=1)[:, None], centres)
    return centres


def nearest_centre(descriptors: Tensor, centres: Float[Tensor, "c d"]) -> Int[Tensor, "n"]:
    """Return the index of the centre nearest to each descriptor."""
    nearest = torch.empty(len(descriptors), dtype=torch.long, device=descriptors.device)
    # Results that are allocated in turn with blocks of distances would fragment the memory.
    for part, found in zip(*(x.split(max(1, BLOCK // len(centres))) for x in (descriptors, nearest)), strict=True):
        found.copy_(squared_distances(part, centres).argmin(1))
    return nearest


def smallest(distances: Float[Tensor, "q n"], count: int) -> tuple[Float[Tensor, "q k"], Int[Tensor, "q k"]]:
    """Return the ``count`` smallest values of each row (all, if there are fewer), ascending, and their columns."""
    nearest = distances.topk(min(count, distances.shape[1]), dim=1, largest=False)
    return nearest.values, nearest.indices


class HalfPrecisionSearch:
    """Descriptors in half precision, which represents bytes exactly; products of unit vectors are rounded by a thousandth."""

    def __init__(self, descriptors: UInt8[Tensor, "n d"]) -> None:
        self._zero, self._descriptors = byte_of_zero(descriptors.cpu().split(MANY)), descriptors
        self._half = self._unit(descriptors)
        self._squares = torch.cat([part.float().square().sum(-1) for part in self._half.split(BLOCK)])

    def _unit(self, descriptors: UInt8[Tensor, "q d"]) -> Float[Tensor, "q d"]:
        return (descriptors.half() - self._zero) / NORM

    def nearest(self, descriptors: UInt8[Tensor, "q d"], count: int) -> tuple[Float[Tensor, "q k"], Int[Tensor, "q k"]]:
        """Return the exact squared distances and the indices of the nearest landmarks, on the CPU."""
        parts, n = [], len(self._half)
        # At most 2^26 products are computed at a time, which bounds the memory.
        for part in descriptors.split(max(1, 2**26 // max(1, n))):
            alike = 2 * (self._unit(part) @ self._half.T).float() - self._squares
            # Products in half precision may be out of order: four more landmarks are looked up, and all are compared exactly.
            index = alike.topk(min(count + 4, n)).indices
            exact = (part[:, None].float() - self._descriptors[index].float()).square().sum(-1)
            distance, best = exact.topk(min(count, n), largest=False)
            parts.append(torch.stack([distance.long(), index.gather(1, best)]))
        distances, indices = torch.cat(parts, 1).cpu()
        return distances.float(), indices


FEW_DESCRIPTORS = 4_000
"""Number of descriptors up to which all are compared, without cells."""


@dataclass(frozen=True, eq=False)
class DescriptorCells:
    """A division of descriptors into k-means cells, which is stored with the landmarks of a map."""

    centres: Float[Tensor, "c d"]
    cell: Int[Tensor, "n"]  # of each descriptor, int32

    @staticmethod
    def of(descriptors: UInt8[Tensor, "n d"]) -> DescriptorCells:
        """Divide descriptors into sqrt(n) cells, or more if there are many."""
        # In large maps, cells have 500 landmarks on average, since comparing more would take most of the time.
        count = round(max(math.sqrt(len(descriptors)), len(descriptors) / 500))
        centres = k_means(descriptors, count, torch.Generator().manual_seed(0))
        return DescriptorCells(centres, nearest_centre(descriptors, centres).int())

    def __getitem__(self, index: Tensor | slice) -> DescriptorCells:
        return DescriptorCells(self.centres, self.cell[index])


class InvertedFile:
    """An inverted file: descriptors sorted by cells, of which only the nearest are searched (Sivic and Zisserman 2003).

    Descriptors that are in the order of their cells are not copied. Raises ``ValueError`` if the cells are those of another
    number of descriptors.
    """

    def __init__(self, descriptors: UInt8[Tensor, "n d"], cells: DescriptorCells) -> None:
        self._centres, cell = cells.centres, cells.cell
        if len(cell) != len(descriptors):
            raise ValueError(f"cells of {len(cell)} descriptors, expected those of the given {len(descriptors)}")
        self._order = cell.argsort(stable=True)
        is_sorted = bool((cell.diff() >= 0).all())
        self._descriptors = descriptors if is_sorted else descriptors[self._order]
        self._squares = torch.empty(len(descriptors))
        for part, squares in zip(self._descriptors.split(MANY), self._squares.split(MANY), strict=True):
            torch.sum(part.float().square_(), -1, out=squares)
        self._first = pad(torch.bincount(cell, minlength=len(self._centres)).cumsum(0), (1, 0))

    def nearest(
        self, descriptors: UInt8[Tensor, "q d"], count: int, cells: int = 12
    ) -> tuple[Float[Tensor, "q k"], Int[Tensor, "q k"]]:
        """Return the squared distances and the indices of the nearest landmarks in the ``cells`` nearest to each descriptor."""
        probed = smallest(squared_distances(descriptors, self._centres), cells)[1]
        counts = torch.diff(self._first)[probed]
        ends = counts.cumsum(1)
        width = int(ends[:, -1].max()) if len(ends) else 0
        # The candidates of a descriptor lie side by side, cell by cell, so that one selection finds the nearest of them all.
        begins = ends - counts + width * torch.arange(len(descriptors))[:, None]
        candidates = torch.full((len(descriptors), width), torch.inf)
        cell, order = probed.flatten().sort(stable=True)
        begins, query, values = begins.flatten()[order, None], order // probed.shape[1], descriptors.float()
        columns, flat = torch.arange(width), candidates.view(-1)
        bounds = torch.searchsorted(cell, torch.arange(len(self._centres) + 1)).tolist()
        for (begin, end), (first, last) in zip(pairwise(bounds), pairwise(self._first.tolist()), strict=True):
            if begin == end or first == last:
                continue
            others = self._descriptors[first:last].float()
            # The squares of the keypoint's own descriptor do not change the order, and are added at the end.
            partial = torch.addmm(self._squares[first:last], values[query[begin:end]], others.T, alpha=-2)
            flat[begins[begin:end] + columns[: last - first]] = partial
        best, column = smallest(candidates, count)
        rank = torch.searchsorted(ends, column, right=True).clamp(max=probed.shape[1] - 1)
        index = self._first[probed.gather(1, rank)] + column - (ends - counts).gather(1, rank)
        squares = values.square().sum(-1, keepdim=True)
        return (best + squares).clamp_(min=0), self._order[index.clamp(max=len(self._order) - 1)]
